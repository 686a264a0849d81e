"""Error-state EKF of IMU and leg kinematics with the feet in the state (Bloesch et al. 2012)."""

from dataclasses import dataclass, field
from typing import cast

import numpy as np

from estbench.estimators.contact_aided import (
    POSITION,
    ROTATION,
    VELOCITY,
    ContactAided,
    ContactBelief,
)
from estbench.estimators.standing_feet import blocks, reaches
from estbench.estimators.update import apply_correction
from estbench.shapes import Array, Float
from estbench.spaces import rotation
from estbench.spaces.linalg import identity
from estbench.spaces.manifold import Manifold


@dataclass(frozen=True)
class ContactEKF(ContactAided):
    """Error-state EKF: IMU prediction, feet on the ground as landmarks that the encoders measure.

    The error is (φ, δv, δp, δd, δb_g, δb_a): φ a rotation in the axes of the IMU, the others
    differences. A standing foot is measured as sᵢ = Rᵀ (dᵢ - p) + J n with the noise n of the
    encoders; a foot that is lifted and put down again starts anew where the joints say (Bloesch,
    Hutter, Hoepflinger, Leutenegger, Gehring, Remy & Siegwart, "State estimation for legged robots
    - consistent fusion of leg kinematics and IMU", RSS 2012, eq. 12-38). Forces and the robot's
    dynamics are not used.

    Position and yaw are not observable: their errors grow with the way. The joints are read off the
    encoders, with a velocity smoothed by a Kalman filter for each joint.

    Cost per step: one kinematics of the robot and matrices of 15 + 3 feet. Choose it on robots with
    IMU, encoders and contact sensors, where the masses are not known well enough for `ekf`.

    Attributes:
        model, threshold, foot_noise, kinematic_noise, gyro_bias, gyro_walk, accelerometer_bias,
        accelerometer_walk, joint_acceleration, slip_gate, settle: as in `ContactAided`.
    """

    _space: Manifold = field(init=False, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        names = tuple(f"e{i}" for i in range(self.n))
        space = Manifold(names, ("1",) * self.n, np.zeros((1, 2), np.intp))
        object.__setattr__(self, "_space", space)

    def _transition(
        self,
        m: Float[Array, "run k"],
        out: Float[Array, "run k"],
        rate: Float[Array, "run 3"],
        force: Float[Array, "run 3"],
        dt: float,
    ) -> Float[Array, "run e e"]:
        """φ⁺ = Exp(ω dt)ᵀ φ - J_r dt δb_g; δv⁺ = δv - R ([a] φ + δb_a) dt, and δp⁺ its integral."""
        F = identity(self.n)[None].repeat(len(m), axis=0)
        R = rotation.matrix(m[:, :4])
        tilt = R @ rotation.skew(force)
        gyro, accelerometer = slice(self.n - 6, self.n - 3), slice(self.n - 3, self.n)
        F[:, ROTATION, ROTATION] = rotation.matrix(rotation.exp(-rate * dt))
        F[:, ROTATION, gyro] = -rotation.right_jacobian(rate * dt) * dt
        F[:, VELOCITY, ROTATION], F[:, POSITION, ROTATION] = -tilt * dt, -0.5 * tilt * dt**2
        F[:, VELOCITY, accelerometer], F[:, POSITION, accelerometer] = -R * dt, -0.5 * R * dt**2
        F[:, POSITION, VELOCITY] = identity(3) * dt
        return F

    def _kinematics(
        self,
        m: Float[Array, "run k"],
        s: Float[Array, "run foot 3"],
        noise: Float[Array, "run foot 3 3"],
    ) -> tuple[Float[Array, "run f"], Float[Array, "run f e"], Float[Array, "run f f"]]:
        """ν = s - Rᵀ (d - p), ∂/∂φ = [Rᵀ (d - p)], ∂/∂d = Rᵀ = -∂/∂p."""
        runs, feet = s.shape[:2]
        R = rotation.matrix(m[:, :4])
        reach = reaches(m, feet)
        predicted = reach @ R
        H = np.zeros((runs, feet, 3, self.n))
        H[..., ROTATION] = rotation.skew(predicted)
        H[..., POSITION] = -R.mT[:, None]
        for i in range(feet):
            H[:, i, :, 9 + 3 * i : 12 + 3 * i] = R.mT
        residual = (s - predicted).reshape(runs, -1)
        return residual, H.reshape(runs, 3 * feet, self.n), blocks(noise)

    def _plus(
        self, belief: ContactBelief, delta: Float[Array, "run e"], cov: Float[Array, "run e e"]
    ) -> ContactBelief:
        return cast(ContactBelief, apply_correction(self._space, belief, delta, cov))

    def _own(
        self, m: Float[Array, "run k"], cov: Float[Array, "run e e"]
    ) -> Float[Array, "run e e"]:
        return cov

    def _plain(
        self, m: Float[Array, "run k"], cov: Float[Array, "run e e"]
    ) -> Float[Array, "run e e"]:
        return cov
