"""What a filter of IMU and leg kinematics takes from a measurement: IMU, joints, contacts."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from estbench.errors import EstimatorError
from estbench.estimators.protocol import Innovation
from estbench.models.legged import Legs
from estbench.models.protocol import Channels, Model
from estbench.shapes import Array, Bool, Float, Int, Mask
from estbench.spaces.linalg import identity


@dataclass(frozen=True, eq=False)
class Read:
    """One measurement, sorted.

    Attributes:
        imu: gyro and accelerometer, the last reading where none arrived.
        felt: whether the whole reading of the IMU arrived.
        joints: encoders, likewise.
        came: whether each encoder's reading arrived.
        legs: whether all encoders of each leg arrived.
    """

    imu: Float[Array, "run 6"]
    felt: Bool[Mask, " run"]
    joints: Float[Array, "run joint"]
    came: Bool[Mask, "run joint"]
    legs: Bool[Mask, "run foot"]


@dataclass(frozen=True, eq=False)
class FootReadings:
    """Where the readings of a legged robot are in a measurement, and their noise.

    Attributes:
        model: of the measurements.
        legs: of the robot.
        threshold: N, touch from which a foot stands.
        name: of the filter, for messages.

    Raises:
        EstimatorError: a foot is moved by fewer than three joints of its own.
    """

    model: Model
    legs: Legs
    threshold: float
    name: str
    _places: Int[NDArray[np.intp], " k"] = field(init=False, repr=False)
    _columns: dict = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        taken: list[int] = []
        for foot, moves in zip(self.legs.touches, self.legs.moves):
            own = [j for j in np.flatnonzero(moves).tolist() if j not in taken]
            if len(own) < 3:
                raise EstimatorError(
                    f"{self.name}: {len(own)} joints of its own move the foot of {foot}; three are "
                    "needed for its position"
                )
            taken += own[:3]
        object.__setattr__(self, "_places", np.sort(np.array(taken, np.intp)))

    def sort(
        self,
        imu: Float[Array, "run 6"],
        joints: Float[Array, "run joint"],
        y: Float[Array, "run ny"],
        channels: Channels,
        mask: Bool[Mask, "run m"] | None,
    ) -> Read:
        """The readings, and what of them arrived."""
        names = (self.legs.gyro, self.legs.accelerometer)
        imu, felt = self._taken(imu, names, 3, y, channels, mask)
        joints, came = self._taken(joints, self.legs.encoders, 1, y, channels, mask)
        whole = (came[:, None] | ~self.legs.moves).all(axis=-1)
        return Read(imu, np.asarray(felt.all(axis=1)), joints, came, np.asarray(whole))

    def touching(
        self,
        standing: Bool[Mask, "run foot"],
        y: Float[Array, "run ny"],
        channels: Channels,
        mask: Bool[Mask, "run m"] | None,
    ) -> Bool[Mask, "run foot"]:
        """Whether each foot touches the ground; as it stood where no reading arrived."""
        none = np.zeros(standing.shape)
        force, came = self._taken(none, self.legs.touches, 1, y, channels, mask)
        return np.where(came, force >= self.threshold, standing)

    def encoder_cov(self, t: float) -> Float[Array, " joint"]:
        """Variance of each encoder, rad² (m² of a slide)."""
        return np.diagonal(self.model.measurement_noise(t, self.legs.encoders))

    def imu_cov(self, t: float) -> Float[Array, "6 6"]:
        """R of gyro and accelerometer."""
        return self.model.measurement_noise(t, (self.legs.gyro, self.legs.accelerometer))

    def spread(self, feet: Innovation, channels: Channels, y: Array) -> Innovation:
        """The innovation of the feet in the places of encoders, `(run, m)` as the measurement."""
        runs, m = y.shape
        where = self._where(channels)
        if not all(name in where for name in self.legs.encoders):
            empty = np.zeros((runs, m))
            eye = identity(m)[None].repeat(runs, axis=0)
            return Innovation(empty, eye, empty, np.zeros(runs), np.zeros(runs, np.int64), eye)
        columns = np.array([where[self.legs.encoders[j]].start for j in self._places])
        assert feet.factor is not None
        residual, white = np.zeros((2, runs, m))
        residual[:, columns], white[:, columns] = feet.residual, feet.white
        S, factor = (identity(m)[None].repeat(runs, axis=0) for _ in range(2))
        S[:, columns[:, None], columns] = feet.cov
        factor[:, columns[:, None], columns] = feet.factor
        return replace(feet, residual=residual, cov=S, white=white, factor=factor, gain=None)

    def _taken(
        self,
        last: Array,
        names: tuple[str, ...],
        width: int,
        y: Array,
        channels: Channels,
        mask: Mask | None,
    ) -> tuple[Array, Mask]:
        """The values of some channels, the last ones where none arrived; and what arrived."""
        where = self._where(channels)
        out, came = last.copy(), np.zeros(last.shape, bool)
        for i, name in enumerate(names):
            if name not in where:
                continue
            place, columns = slice(i * width, (i + 1) * width), where[name]
            came[:, place] = True if mask is None else mask[:, columns]
            out[:, place] = np.where(came[:, place], y[:, columns], out[:, place])
        return out, came

    def _where(self, channels: Channels) -> dict[str, slice]:
        """Columns of each channel of a measurement."""
        names = self.legs.order if channels is None else tuple(channels)
        if names not in self._columns:
            start, found = 0, {}
            for name in names:
                end = start + self.model.output((name,)).n
                found[name] = slice(start, end)
                start = end
            self._columns[names] = found
        return self._columns[names]


def joint_step(
    joints: Float[Array, "run 2 joint"],
    cov: Float[Array, "run 3 joint"],
    acceleration: float,
    dt: float,
) -> tuple[Float[Array, "run 2 joint"], Float[Array, "run 3 joint"]]:
    """Angle and velocity of each joint after dt, driven by white acceleration.

    q⁺ = q + dt q̇; Q of white noise of density a² (Bar-Shalom et al. 2001, eq. 6.2.2-12).
    """
    (q, rate), (qq, qv, vv), s = joints.swapaxes(0, 1), cov.swapaxes(0, 1), acceleration**2
    grown = [
        qq + 2 * dt * qv + dt**2 * vv + s * dt**3 / 3,
        qv + dt * vv + s * dt**2 / 2,
        vv + s * dt,
    ]
    return np.stack([q + dt * rate, rate], axis=1), np.stack(grown, axis=1)


def joint_filter(
    joints: Float[Array, "run 2 joint"],
    cov: Float[Array, "run 3 joint"],
    angles: Float[Array, "run joint"],
    variance: Float[Array, " joint"],
    came: Bool[Mask, "run joint"],
) -> tuple[Float[Array, "run 2 joint"], Float[Array, "run 3 joint"]]:
    """Each joint given its encoder, a Kalman filter of two states."""
    (q, rate), (qq, qv, vv) = joints.swapaxes(0, 1), cov.swapaxes(0, 1)
    S, residual = qq + variance, angles - q
    gain = np.where(came, np.stack([qq, qv]) / S, 0.0)
    mean = np.stack([q + gain[0] * residual, rate + gain[1] * residual], axis=1)
    after = [qq - gain[0] * qq, qv - gain[0] * qv, vv - gain[1] * qv]
    return mean, np.stack(after, axis=1)
