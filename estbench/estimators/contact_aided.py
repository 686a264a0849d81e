"""Base of the filters of IMU and leg kinematics: what they share beside their error coordinates.

State: pose (R, p) and velocity v of the IMU in the world, feet dᵢ in the world, IMU biases. The IMU
drives the prediction, feet on the ground are measured by the encoders, and joints are read off the
encoders. Process noise of the base that the scenario has is added: the IMU does not feel it.
"""

from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np

from estbench.errors import EstimatorError, ScenarioError
from estbench.estimators.base_state import BaseState
from estbench.estimators.beliefs import Gaussian, check_prior
from estbench.estimators.foot_readings import FootReadings, joint_filter, joint_step
from estbench.estimators.linear import joseph, predicted_cov
from estbench.estimators.protocol import Innovation
from estbench.estimators.settings import in_range
from estbench.estimators.standing_feet import rolling, slipping
from estbench.estimators.update import correct, mark_failed
from estbench.models.legged import LeggedModel, Legs
from estbench.models.protocol import Channels
from estbench.models.seen_noise import SeenNoise
from estbench.shapes import Array, Bool, Float, Mask
from estbench.spaces import rotation
from estbench.spaces.linalg import identity, symmetrize

ROTATION, VELOCITY, POSITION = slice(0, 3), slice(3, 6), slice(6, 9)
"""Of the error; the feet follow, then the biases of gyro and accelerometer."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ContactBelief(Gaussian):
    """A Gaussian of base, feet and biases, and what was read last.

    Attributes:
        mean: (q, v, p, d₁, ..., b_g, b_a) with the unit quaternion q of R.
        cov: of the error of the filter, in its own coordinates.
        imu: last gyro and accelerometer reading, rad/s and m/s².
        imu_cov: covariance of this reading.
        joints: angle and velocity of each joint.
        joint_cov: their variances and covariance: angle, both, velocity.
        standing: whether each foot is on the ground.
        measured: whether it was held to be where it was at the last reading.
        age: time since it came down, s.
        rolling: velocity in the world with which it rolls, m/s.
    """

    imu: Float[Array, "run 6"]
    imu_cov: Float[Array, "run 6 6"]
    joints: Float[Array, "run 2 joint"]
    joint_cov: Float[Array, "run 3 joint"]
    standing: Bool[Mask, "run foot"]
    measured: Bool[Mask, "run foot"]
    age: Float[Array, "run foot"]
    rolling: Float[Array, "run foot 3"]


@dataclass(frozen=True)
class ContactAided:
    """Base of the filters of IMU and leg kinematics; a subclass has the coordinates of the error.

    The error in plain coordinates is (φ in the body, δv, δp, δd, δb). The subclass gives F
    (`_transition`), ν, H and R of the feet (`_kinematics`), the correction (`_plus`), and a
    covariance in its coordinates from one in plain coordinates and back (`_own`, `_plain`).

    Attributes:
        model: one with legs (`models.legged.LeggedModel`).
        threshold: N, touch from which a foot stands; default a quarter of the weight of the robot
            over the number of feet.
        foot_noise: m/√s, random walk of a standing foot: it slides and sinks.
        kinematic_noise: m, std of a foot in the IMU's frame beyond the noise of the encoders.
        gyro_bias: rad/s, std of the bias at the start.
        gyro_walk: rad/s/√s, its random walk.
        accelerometer_bias: m/s², std of the bias at the start.
        accelerometer_walk: m/s²/√s, its random walk.
        joint_acceleration: rad/s²/√Hz, white acceleration with which the joints are smoothed.
        slip_gate: probability that a foot that stands passes the gate. One that does not slips: it
            starts anew where the joints say (`standing_feet.slipping`); 1: no foot slips.
        settle: s from touch-down until a foot is measured: it slides and sinks before.
    """

    model: LeggedModel
    threshold: float | None = None
    foot_noise: float = 0.004
    kinematic_noise: float = 0.0
    gyro_bias: float = 0.0
    gyro_walk: float = 0.0
    accelerometer_bias: float = 0.0
    accelerometer_walk: float = 0.0
    joint_acceleration: float = 3.0
    slip_gate: float = 0.999
    settle: float = 0.01
    _legs: Legs = field(init=False, repr=False)
    _base: BaseState = field(init=False, repr=False)
    _readings: FootReadings = field(init=False, repr=False)

    def __post_init__(self) -> None:
        name = type(self).__name__
        if isinstance(self.model, SeenNoise):
            raise EstimatorError(
                f"{name}: the sensors see the disturbance of the last interval, which a filter "
                'driven by them cannot; set process_noise.accelerometer_sees = "control"'
            )
        try:
            legs = getattr(self.model, "legs", None)
        except ScenarioError as error:
            raise EstimatorError(f"{name}: {error}; or use ekf, ukf") from None
        if legs is None:
            raise EstimatorError(f"{name}: the model has no legs; use ekf, ukf, or a MuJoCo model")
        for setting in (
            "foot_noise", "kinematic_noise", "gyro_bias", "gyro_walk", "accelerometer_bias",
            "accelerometer_walk", "joint_acceleration", "settle",
        ):  # fmt: skip
            in_range(self, setting, 0.0)
        in_range(self, "slip_gate", 0.0, 1.0, low_open=True)
        if self.threshold is not None:
            in_range(self, "threshold", 0.0)
        force = self.threshold
        if force is None:
            force = 0.25 * legs.weight / len(legs.touches)
        object.__setattr__(self, "_legs", legs)
        object.__setattr__(self, "_base", BaseState(legs, self.model.space))
        object.__setattr__(self, "_readings", FootReadings(self.model, legs, force, name))

    @property
    def n(self) -> int:
        """Coordinates of the filter's error."""
        return 15 + 3 * len(self._legs.touches)

    def init(self, mean: Float[Array, "run nx"], cov: Float[Array, "run n n"]) -> ContactBelief:
        """Start from N(mean, cov): the feet are where the joints put them, the biases are zero.

        Up to the first reading of the IMU the robot is taken to be at rest, with an acceleration
        of standard deviation g.
        """
        check_prior(self.model.space, mean, cov)
        runs, feet = len(mean), len(self._legs.touches)
        base, P, imu, imu_cov = self._base.start(mean, cov)
        joints, joint_cov = self._base.joints(mean, cov)
        state = np.concatenate([base, np.zeros((runs, 3 * feet + 6))], axis=1)
        whole = np.zeros((runs, self.n, self.n))
        whole[:, :9, :9] = P
        std = [self.gyro_bias] * 3 + [self.accelerometer_bias] * 3
        whole[:, range(-6, 0), range(-6, 0)] = np.square(std)
        belief = ContactBelief(
            state, self._own(state, whole), np.zeros(runs, np.uint8), imu=imu, imu_cov=imu_cov,
            joints=joints, joint_cov=joint_cov, standing=np.zeros((runs, feet), bool),
            measured=np.zeros((runs, feet), bool), age=np.zeros((runs, feet)),
            rolling=np.zeros((runs, feet, 3)),
        )  # fmt: skip
        s, J, _ = self._legs.feet(joints[:, 0])
        noise = (J * joint_cov[:, 0, None, None, :]) @ J.mT
        return self._placed(belief, s, noise, np.ones((runs, feet), bool))

    def predict(
        self, belief: ContactBelief, u: Float[Array, "run nu"], t: float, dt: float
    ) -> ContactBelief:
        """The IMU's last reading, held over dt."""
        m, k = belief.mean, 10 + 3 * len(self._legs.touches)
        rate = belief.imu[:, :3] - m[:, k : k + 3]
        force = belief.imu[:, 3:] - m[:, k + 3 :]
        out = m.copy()
        R = rotation.matrix(m[:, :4])
        push = (R @ force[..., None])[..., 0] + self._legs.gravity
        out[:, :4] = rotation.normalize(rotation.multiply(m[:, :4], rotation.exp(rate * dt)))
        out[:, 4:7] += push * dt
        out[:, 7:10] += m[:, 4:7] * dt + 0.5 * push * dt**2
        out[:, 10:k] += belief.rolling.reshape(len(m), -1) * dt
        F = self._transition(m, out, rate, force, dt)
        cov = predicted_cov(F, belief.cov, self._noise(belief, out, F, u, t, dt))
        joints, joint_cov = joint_step(belief.joints, belief.joint_cov, self.joint_acceleration, dt)
        ahead = replace(
            belief, mean=out, cov=cov, joints=joints, joint_cov=joint_cov, age=belief.age + dt
        )
        return cast(ContactBelief, mark_failed(ahead))

    def update(
        self,
        belief: ContactBelief,
        y: Float[Array, "run ny"],
        u: Float[Array, "run nu"],
        t: float,
        channels: Channels = None,
        mask: Bool[Mask, "run m"] | None = None,
    ) -> tuple[ContactBelief, Innovation]:
        """Keep the IMU's reading; correct by the feet that stand, and put down the others.

        The innovation ν of a standing foot is its measured less its predicted position. Its three
        numbers are in the places of encoders of its leg; every other component has ν = 0, S = 1 and
        is no degree of freedom.
        """
        read = self._readings.sort(belief.imu, belief.joints[:, 0], y, channels, mask)
        joints, joint_cov = joint_filter(
            belief.joints, belief.joint_cov, read.joints, self._readings.encoder_cov(t), read.came
        )
        imu_cov = np.where(read.felt[:, None, None], self._readings.imu_cov(t), belief.imu_cov)
        belief = replace(belief, imu=read.imu, imu_cov=imu_cov, joints=joints, joint_cov=joint_cov)
        touching = self._readings.touching(belief.standing, y, channels, mask)
        s, J, turns = self._legs.feet(read.joints)
        noise = (J * self._readings.encoder_cov(t)) @ J.mT
        noise = noise + self.kinematic_noise**2 * identity(3)
        residual, H, R = self._kinematics(belief.mean, s, noise)
        PHt = belief.cov @ H.mT
        S = symmetrize(H @ PHt + R)
        measured = belief.standing & touching & read.legs & (belief.age > self.settle - 1e-9)
        measured &= ~slipping(residual, S, self.slip_gate)
        c = correct(residual, S, PHt, np.repeat(measured, 3, axis=1))
        cov = symmetrize(joseph(belief.cov, c.gain, H, R))
        corrected = mark_failed(self._plus(belief, c.delta, cov), c.fault)
        belief = cast(ContactBelief, corrected)
        belief = self._placed(belief, s, noise, read.legs & ~measured)
        standing = np.where(read.legs, touching, belief.standing & touching)
        belief = replace(
            belief, standing=standing, measured=measured, rolling=self._rolling(belief, turns),
            age=np.where(belief.standing & standing, belief.age, 0.0),
        )  # fmt: skip
        return belief, self._readings.spread(c.innovation, channels, y)

    def mean(self, belief: ContactBelief) -> Float[Array, "run nx"]:
        """x̂: the base of the filter, the joints of the encoders."""
        return self._base.mean(belief.mean, belief.imu, belief.joints)

    def cov(self, belief: ContactBelief) -> Float[Array, "run n n"]:
        """P of x̂; joints and base are taken as independent."""
        return self._base.cov(
            belief.mean, belief.imu, self._plain(belief.mean, belief.cov),
            belief.imu_cov[:, :3, :3], belief.joint_cov,
        )  # fmt: skip

    def biases(self, belief: ContactBelief) -> dict[str, tuple[Array, Array]]:
        """Name -> estimate and standard deviation of each bias, rad/s and m/s²."""
        std = np.sqrt(np.diagonal(belief.cov, axis1=-2, axis2=-1)[:, -6:])
        names = [f"{c}.{a}" for c in (self._legs.gyro, self._legs.accelerometer) for a in "xyz"]
        return {f"bias.{n}": (belief.mean[:, i - 6], std[:, i]) for i, n in enumerate(names)}

    def _rolling(self, belief: ContactBelief, turns: Array) -> Float[Array, "run foot 3"]:
        """Velocity with which the feet roll on level ground, if they are on it."""
        k, legs = 10 + 3 * len(self._legs.touches), self._legs
        up = -legs.gravity / np.linalg.norm(legs.gravity)
        rate, R = belief.imu[:, :3] - belief.mean[:, k : k + 3], rotation.matrix(belief.mean[:, :4])
        return rolling(rate, turns, belief.joints[:, 1], R, legs.radii, up)

    def _noise(
        self, belief: ContactBelief, out: Array, F: Array, u: Array, t: float, dt: float
    ) -> Float[Array, "run e e"]:
        """Q: noise of the IMU, which acts as the biases do, and of what it does not feel."""
        driven = F[:, :, -6:].copy()
        driven[:, -6:] = 0.0
        Q = driven @ belief.imu_cov @ driven.mT
        unfelt = np.zeros_like(Q)
        model = self.model.process_noise(self.mean(belief), u, t, dt)
        unfelt[:, :9, :9] = self._base.noise(out, belief.imu, model)
        walk = [self.foot_noise] * (self.n - 15)
        walk += [self.gyro_walk] * 3 + [self.accelerometer_walk] * 3
        unfelt[:, range(9, self.n), range(9, self.n)] = np.square(walk) * dt
        return Q + self._own(out, unfelt)

    def _placed(
        self,
        belief: ContactBelief,
        s: Float[Array, "run foot 3"],
        noise: Float[Array, "run foot 3 3"],
        chosen: Bool[Mask, "run foot"],
    ) -> ContactBelief:
        """Put feet where the joints say: d = p + R s, and the errors with them."""
        if not chosen.any():
            return belief
        runs, feet = chosen.shape
        R = rotation.matrix(belief.mean[:, :4])
        world = (R[:, None] @ s[..., None])[..., 0]
        mean, rows = belief.mean.copy(), np.repeat(chosen, 3, axis=1)
        place = (belief.mean[:, None, 7:10] + world).reshape(runs, -1)
        mean[:, 10 : 10 + 3 * feet] = np.where(rows, place, mean[:, 10 : 10 + 3 * feet])
        # δd = δp - R [s] φ - R J n, with the noise n of the encoders.
        A = identity(self.n)[None].repeat(runs, axis=0)
        added = np.zeros_like(A)
        for i in range(feet):
            at, which = slice(9 + 3 * i, 12 + 3 * i), chosen[:, i]
            A[which, at, at] = 0.0
            A[which, at, POSITION] = identity(3)
            A[which, at, ROTATION] = -(R @ rotation.skew(s[:, i]))[which]
            added[which, at, at] = (R @ noise[:, i] @ R.mT)[which]
        cov = A @ self._plain(belief.mean, belief.cov) @ A.mT + added
        # A run without such a foot keeps its numbers to the bit, whatever the others do.
        some = chosen.any(axis=1)[:, None, None]
        cov = np.where(some, symmetrize(self._own(mean, cov)), belief.cov)
        return replace(belief, mean=mean, cov=cov)

    def _transition(
        self,
        m: Float[Array, "run k"],
        out: Float[Array, "run k"],
        rate: Float[Array, "run 3"],
        force: Float[Array, "run 3"],
        dt: float,
    ) -> Float[Array, "run e e"]:
        """F from the error at the state m to that at the state `out`, dt later."""
        raise NotImplementedError

    def _kinematics(
        self,
        m: Float[Array, "run k"],
        s: Float[Array, "run foot 3"],
        noise: Float[Array, "run foot 3 3"],
    ) -> tuple[Float[Array, "run f"], Float[Array, "run f e"], Float[Array, "run f f"]]:
        """ν, H and R of the measured feet s in the frame of the IMU."""
        raise NotImplementedError

    def _plus(
        self, belief: ContactBelief, delta: Float[Array, "run e"], cov: Float[Array, "run e e"]
    ) -> ContactBelief:
        """The belief corrected by δ, with the covariance of the error before the correction."""
        raise NotImplementedError

    def _own(
        self, m: Float[Array, "run k"], cov: Float[Array, "run e e"]
    ) -> Float[Array, "run e e"]:
        """A covariance in plain coordinates, in those of the filter."""
        raise NotImplementedError

    def _plain(
        self, m: Float[Array, "run k"], cov: Float[Array, "run e e"]
    ) -> Float[Array, "run e e"]:
        """The reverse of `_own`."""
        raise NotImplementedError
