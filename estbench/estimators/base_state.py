"""The state of a robot from the pose and velocity of its IMU and from its joints, and back.

With the IMU at r in the base, axes C: R_IMU = R C, p_IMU = p + R r, v_IMU = v + R (ω × r). In the
tangents (φ in the body, the others in the world) φ_IMU = Cᵀ φ, δp_IMU = δp - R [r] φ and
δv_IMU = δv - R [ω × r] φ - R [r] δω.
"""

from dataclasses import dataclass

import numpy as np

from estbench.models.legged import Legs
from estbench.shapes import Array, Float, Int, Ints
from estbench.spaces import rotation
from estbench.spaces.linalg import identity
from estbench.spaces.manifold import Manifold


@dataclass(frozen=True, eq=False)
class BaseState:
    """The two ways between the state and the base of a filter of IMU and leg kinematics.

    The filter's base is (q, v, p) of the IMU, its error (φ, δv, δp); the state's base has the
    tangent (δp, φ, δv, δω).

    Attributes:
        legs: of the robot.
        space: of the state.
    """

    legs: Legs
    space: Manifold

    def start(
        self, mean: Float[Array, "run nx"], cov: Float[Array, "run n n"]
    ) -> tuple[
        Float[Array, "run 10"],
        Float[Array, "run 9 9"],
        Float[Array, "run 6"],
        Float[Array, "run 6 6"],
    ]:
        """(q, v, p) of the IMU, its covariance, its reading at rest, and that one's covariance."""
        legs, at, v = self.legs, self.legs.root[0], self.legs.velocity[0]
        q, rate = mean[:, at + 3 : at + 7], mean[:, v + 3 : v + 6]
        R = rotation.matrix(q)
        axes = np.broadcast_to(rotation.from_matrix(legs.axes), q.shape)
        position = mean[:, at : at + 3] + R @ legs.offset
        velocity = mean[:, v : v + 3] + (R @ _cross(rate, legs.offset)[..., None])[..., 0]
        base = [rotation.normalize(rotation.multiply(q, axes)), velocity, position]
        force = -((legs.gravity @ R)[:, None] @ legs.axes)[:, 0]
        M = self._inward(R, rate)
        chosen = self._tangent()
        P = cov[:, chosen[:, None], chosen]
        imu_cov = np.zeros((len(mean), 6, 6))
        imu_cov[:, :3, :3] = legs.axes.T @ P[:, 9:, 9:] @ legs.axes
        imu_cov[:, 3:, 3:] = (legs.gravity @ legs.gravity) * identity(3)
        imu = np.concatenate([(rate[:, None] @ legs.axes)[:, 0], force], axis=1)
        return np.concatenate(base, axis=1), M @ P @ M.mT, imu, imu_cov

    def joints(
        self, mean: Float[Array, "run nx"], cov: Float[Array, "run n n"]
    ) -> tuple[Float[Array, "run 2 joint"], Float[Array, "run 3 joint"]]:
        """Angle and velocity of each joint, and their variances and covariance."""
        (x, n), (dx, dn) = self.legs.joints.T, self.legs.rates.T
        parts = [cov[:, n, n], cov[:, n, dn], cov[:, dn, dn]]
        return np.stack([mean[:, x], mean[:, dx]], axis=1), np.stack(parts, axis=1)

    def mean(
        self, m: Float[Array, "run k"], imu: Float[Array, "run 6"], joints: Array
    ) -> Float[Array, "run nx"]:
        """x̂ of the filter's (q, v, p, ..., b_g, b_a), the IMU's reading and the joints."""
        legs, at, v = self.legs, self.legs.root[0], self.legs.velocity[0]
        R, rate = self._attitude(m, imu)
        x = np.zeros((len(m), self.space.nx))
        axes = np.broadcast_to(rotation.from_matrix(legs.axes), m[:, :4].shape)
        x[:, at : at + 3] = m[:, 7:10] - R @ legs.offset
        x[:, at + 3 : at + 7] = rotation.normalize(
            rotation.multiply(m[:, :4], rotation.conjugate(axes))
        )
        turning = (R @ _cross(rate, legs.offset)[..., None])[..., 0]
        x[:, v : v + 3], x[:, v + 3 : v + 6] = m[:, 4:7] - turning, rate
        x[:, legs.joints[:, 0]], x[:, legs.rates[:, 0]] = joints[:, 0], joints[:, 1]
        return x

    def cov(
        self,
        m: Float[Array, "run k"],
        imu: Float[Array, "run 6"],
        P: Float[Array, "run e e"],
        rate_cov: Float[Array, "run 3 3"],
        joint_cov: Float[Array, "run 3 joint"],
    ) -> Float[Array, "run n n"]:
        """P of x̂; ω is the gyro's reading less the bias, so δω_IMU = -(δb_g + noise)."""
        R, rate = self._attitude(m, imu)
        chosen = np.r_[0:9, P.shape[-1] - 6 : P.shape[-1] - 3]
        sign = np.r_[np.ones(9), -np.ones(3)]
        inner = P[:, chosen[:, None], chosen] * (sign[:, None] * sign)
        inner[:, 9:, 9:] += rate_cov
        M = self._outward(R, rate)
        out = np.zeros((len(m), self.space.n, self.space.n))
        at = self._tangent()
        out[:, at[:, None], at] = M @ inner @ M.mT
        n, dn = self.legs.joints[:, 1], self.legs.rates[:, 1]
        out[:, n, n], out[:, dn, dn] = joint_cov[:, 0], joint_cov[:, 2]
        out[:, n, dn] = out[:, dn, n] = joint_cov[:, 1]
        return out

    def noise(
        self, m: Float[Array, "run k"], imu: Float[Array, "run 6"], Q: Float[Array, "... n n"]
    ) -> Float[Array, "run 9 9"]:
        """Process noise of the state, as one of (φ, δv, δp)."""
        M, at = self._inward(*self._attitude(m, imu)), self._tangent()
        return M @ Q[..., at[:, None], at] @ M.mT

    def _attitude(self, m: Array, imu: Array) -> tuple[Array, Array]:
        """R of the base and ω in its axes."""
        R = rotation.matrix(m[:, :4]) @ self.legs.axes.T
        return R, ((imu[:, None, :3] - m[:, None, -6:-3]) @ self.legs.axes.T)[:, 0]

    def _tangent(self) -> Int[Ints, " k"]:
        """Places of (δp, φ, δv, δω) in the tangent."""
        root, velocity = self.legs.root[1], self.legs.velocity[1]
        return np.r_[root : root + 6, velocity : velocity + 6]

    def _inward(self, R: Array, rate: Array) -> Float[Array, "run 9 12"]:
        """(δp, φ, δv, δω) of the base -> (φ, δv, δp) of the IMU."""
        arm = R @ rotation.skew(self.legs.offset)
        M = np.zeros((len(R), 9, 12))
        M[:, 0:3, 3:6] = self.legs.axes.T
        M[:, 3:6, 6:9] = M[:, 6:9, 0:3] = identity(3)
        M[:, 3:6, 3:6] = -R @ rotation.skew(_cross(rate, self.legs.offset))
        M[:, 3:6, 9:12] = M[:, 6:9, 3:6] = -arm
        return M

    def _outward(self, R: Array, rate: Array) -> Float[Array, "run 12 12"]:
        """(φ, δv, δp, δω) of the IMU -> (δp, φ, δv, δω) of the base."""
        arm = R @ rotation.skew(self.legs.offset) @ self.legs.axes
        turned = R @ rotation.skew(_cross(rate, self.legs.offset)) @ self.legs.axes
        M = np.zeros((len(R), 12, 12))
        M[:, 3:6, 0:3] = M[:, 9:12, 9:12] = self.legs.axes
        M[:, 0:3, 6:9] = M[:, 6:9, 3:6] = identity(3)
        M[:, 0:3, 0:3] = M[:, 6:9, 9:12] = arm
        M[:, 6:9, 0:3] = turned
        return M


def _cross(rate: Float[Array, "run 3"], arm: Float[Array, " 3"]) -> Float[Array, "run 3"]:
    """ω × r."""
    return -(rotation.skew(arm) @ rate[..., None])[..., 0]
