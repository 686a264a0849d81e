"""Contact-aided invariant EKF of IMU and leg kinematics (Hartley et al. 2020)."""

from dataclasses import dataclass, replace

import numpy as np

from estbench.estimators.contact_aided import (
    POSITION,
    ROTATION,
    VELOCITY,
    ContactAided,
    ContactBelief,
)
from estbench.estimators.standing_feet import blocks, reaches
from estbench.shapes import Array, Float
from estbench.spaces import rotation
from estbench.spaces.linalg import identity


@dataclass(frozen=True)
class ContactInEKF(ContactAided):
    """Right-invariant EKF: the error ξ of X = Exp(ξ) X̂ in SE_{2+N}(3), X = (R, v, p, d₁, ..., d_N).

    ξ = (ξ_R, ξ_v, ξ_p, ξ_d, δb_g, δb_a) is in the world: R = Exp(ξ_R) R̂ and, to the first order,
    ξ_x = δx + [x̂] ξ_R for x = v, p, d. Without biases the error propagates independently of the
    estimate and H = (0, 0, -1, 1) is constant, so that yaw and position stay unobservable in the
    filter as they are on the robot (Hartley, Ghaffari, Eustice & Grizzle, "Contact-aided invariant
    extended Kalman filtering for robot state estimation", Int. J. Robotics Research 39(4), 2020,
    sec. 4-6). Everything else is as in `ContactEKF`.

    Cost per step: that of `ContactEKF`. Choose it where the attitude at the start is poorly known,
    or the robot turns.

    Attributes:
        model, threshold, foot_noise, kinematic_noise, gyro_bias, gyro_walk, accelerometer_bias,
        accelerometer_walk, joint_acceleration, slip_gate, settle: as in `ContactAided`.
    """

    def _transition(
        self,
        m: Float[Array, "run k"],
        out: Float[Array, "run k"],
        rate: Float[Array, "run 3"],
        force: Float[Array, "run 3"],
        dt: float,
    ) -> Float[Array, "run e e"]:
        """ξ_v⁺ = ξ_v + [g] ξ_R dt, ξ_p⁺ = ξ_p + ξ_v dt + [g] ξ_R dt²/2; the biases enter by R."""
        F = identity(self.n)[None].repeat(len(m), axis=0)
        pull = rotation.skew(self._legs.gravity)
        F[:, VELOCITY, ROTATION], F[:, POSITION, ROTATION] = pull * dt, 0.5 * pull * dt**2
        F[:, POSITION, VELOCITY] = identity(3) * dt
        gyro, accelerometer = slice(self.n - 6, self.n - 3), slice(self.n - 3, self.n)
        R = rotation.matrix(m[:, :4])
        turned = rotation.matrix(out[:, :4]) @ rotation.right_jacobian(rate * dt) * dt
        F[:, ROTATION, gyro] = -turned
        F[:, 3 : self.n - 6, gyro] = -(_levers(out) @ turned)
        F[:, VELOCITY, accelerometer], F[:, POSITION, accelerometer] = -R * dt, -0.5 * R * dt**2
        return F

    def _kinematics(
        self,
        m: Float[Array, "run k"],
        s: Float[Array, "run foot 3"],
        noise: Float[Array, "run foot 3 3"],
    ) -> tuple[Float[Array, "run f"], Float[Array, "run f e"], Float[Array, "run f f"]]:
        """ν = R s - (d - p) in the world, H = ξ_d - ξ_p."""
        runs, feet = s.shape[:2]
        R = rotation.matrix(m[:, :4])
        reach = reaches(m, feet)
        H = np.zeros((feet, 3, self.n))
        H[..., POSITION] = -identity(3)
        H[:, :, 9 : 9 + 3 * feet] = identity(3 * feet).reshape(feet, 3, 3 * feet)
        H = H.reshape(1, 3 * feet, self.n).repeat(runs, axis=0)
        world = R[:, None] @ noise @ R[:, None].mT
        return (s @ R.mT - reach).reshape(runs, -1), H, blocks(world)

    def _plus(
        self, belief: ContactBelief, delta: Float[Array, "run e"], cov: Float[Array, "run e e"]
    ) -> ContactBelief:
        """X̂⁺ = Exp(δ) X̂: each x of v, p, d becomes Exp(δ_R) x + J_l(δ_R) δ_x."""
        mean, k = belief.mean.copy(), self.n - 5
        turn = rotation.exp(delta[:, ROTATION])
        mean[:, :4] = rotation.normalize(rotation.multiply(turn, mean[:, :4]))
        vectors = mean[:, 4:k].reshape(len(mean), -1, 3)
        moves = delta[:, 3 : self.n - 6].reshape(len(mean), -1, 3)
        left = rotation.right_jacobian(-delta[:, ROTATION])
        vectors = vectors @ rotation.matrix(turn).mT + moves @ left.mT
        mean[:, 4:k] = vectors.reshape(len(mean), -1)
        mean[:, k:] += delta[:, -6:]
        return replace(belief, mean=mean, cov=cov)

    def _own(
        self, m: Float[Array, "run k"], cov: Float[Array, "run e e"]
    ) -> Float[Array, "run e e"]:
        """ξ_R = R φ, ξ_x = δx + [x] R φ."""
        T = identity(self.n)[None].repeat(len(m), axis=0)
        R = rotation.matrix(m[:, :4])
        T[:, ROTATION, ROTATION], T[:, 3 : self.n - 6, ROTATION] = R, _levers(m) @ R
        return T @ cov @ T.mT

    def _plain(
        self, m: Float[Array, "run k"], cov: Float[Array, "run e e"]
    ) -> Float[Array, "run e e"]:
        """φ = Rᵀ ξ_R, δx = ξ_x - [x] ξ_R."""
        T = identity(self.n)[None].repeat(len(m), axis=0)
        T[:, ROTATION, ROTATION] = rotation.matrix(m[:, :4]).mT
        T[:, 3 : self.n - 6, ROTATION] = -_levers(m)
        return T @ cov @ T.mT


def _levers(m: Float[Array, "run k"]) -> Float[Array, "run f 3"]:
    """[x] of velocity, position and feet, one under the other."""
    runs = len(m)
    return rotation.skew(m[:, 4:-6].reshape(runs, -1, 3)).reshape(runs, -1, 3)
