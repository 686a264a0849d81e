"""The errors of the sensors as further states: biases, drifts, scale factors and misalignments.

What destroys information and adds none (quantization, saturation, deadband, stuck-at faults) is
left out: no estimator is better for it, so that the bound remains one.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estbench.bounds.linearization import Linearized
from estbench.bounds.noise import information
from estbench.models.protocol import Channels
from estbench.sensors.channel import Channel
from estbench.shapes import Array, Float
from estbench.spaces.manifold import Manifold
from estbench.spaces.rotation import skew


@dataclass(frozen=True, eq=False)
class SensorError:
    """One error of a channel, with a coordinate for each axis.

    Attributes:
        channel: its name.
        kind: `bias`, `drift`, `scale_factor` or `misalignment`.
        std: at the start; a zero is a coordinate that stays zero.
        walk: intensity of a random walk, unit/√s.
        drift_time: correlation time of a stationary error, s; infinite for a constant or a walk.
    """

    channel: str
    kind: str
    std: Float[Array, " k"]
    walk: Float[Array, " k"]
    drift_time: float = np.inf

    def keep(self, dt: float) -> float:
        """What is left of the error after dt."""
        return float(np.exp(-dt / self.drift_time))

    def root(self, dt: float) -> Float[Array, " k"]:
        """Standard deviation of what is new after dt."""
        return self.walk * np.sqrt(dt) + self.std * np.sqrt(1.0 - self.keep(dt) ** 2)

    def slope(self, clean: Float[Array, "run _"]) -> Float[Array, "... m k"]:
        """Change of the reading by a unit of each coordinate, at noise-free readings."""
        if self.kind == "scale_factor":
            return clean[..., None] * np.eye(clean.shape[-1])
        if self.kind == "misalignment":  # (I + [c]×) y, c the coordinates
            return -skew(clean)
        return np.eye(len(self.std))


@dataclass(frozen=True, eq=False)
class WithSensorErrors:
    """A system whose state also holds the errors of its sensors.

    Attributes:
        system: without them.
        channels: of the truth.
        errors: that are unknown.
    """

    system: Linearized
    channels: Sequence[Channel]
    errors: Sequence[SensorError]

    @property
    def std(self) -> Float[Array, " k"]:
        """Standard deviations of the errors at the start."""
        return np.concatenate([np.zeros(0), *(e.std for e in self.errors)])

    def transition(
        self,
        x: Float[Array, "run nx"],
        after: Float[Array, "run nx"],
        u: Float[Array, "run nu"],
        t: float,
        dt: float,
    ) -> tuple[Float[Array, "run _ _"], Float[Array, "... _ _"]]:
        """See `Linearized.transition`."""
        F, G = self.system.transition(x, after, u, t, dt)
        if not self.errors:
            return F, G
        keep = np.concatenate([np.full(len(e.std), e.keep(dt)) for e in self.errors])
        root = np.diag(np.concatenate([e.root(dt) for e in self.errors]))
        return _diagonal(F, np.diag(keep)), _diagonal(G, root[:, root.any(axis=0)])

    def measurement(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float, channels: Channels
    ) -> tuple[Float[Array, "run ny"], Float[Array, "run m _"], Float[Array, "... m m"]]:
        """See `Linearized.measurement`."""
        y, H, R = self.system.measurement(x, u, t, channels)
        known = {c.name: c for c in self.channels}
        E = np.zeros((*H.shape[:-1], sum(len(e.std) for e in self.errors)))
        R, row, start = R.copy(), 0, 0
        for name in known if channels is None else channels:
            space = known[name].space
            rows, clean = slice(row, row + space.n), y[:, start : start + space.nx]
            R[..., rows, rows] /= noise_information(known[name])
            column = 0
            for error in self.errors:
                columns = slice(column, column + len(error.std))
                if error.channel == name:
                    E[:, rows, columns] = error.slope(clean)
                column = columns.stop
            row, start = rows.stop, start + space.nx
        return y, np.concatenate([H, E], axis=-1), R

    def output(self, channels: Channels) -> Manifold:
        """See `Linearized.output`."""
        return self.system.output(channels)


def errors(channel: Channel) -> list[SensorError]:
    """The errors of a channel that an estimator might estimate."""
    part, m = channel.imperfections, channel.space.n
    if part is None:
        return []
    none = np.zeros(m)
    candidates = (
        SensorError(channel.name, "bias", part.bias, part.walk),
        SensorError(channel.name, "drift", part.drift, none, part.drift_time),
        SensorError(channel.name, "scale_factor", part.scale_factor, none),
        SensorError(channel.name, "misalignment", np.full(3, part.misalignment), np.zeros(3)),
    )
    return [error for error in candidates if error.std.any() or error.walk.any()]


def noise_information(channel: Channel) -> float:
    """The information of a reading's noise, over that of a Gaussian of equal R."""
    part = channel.imperfections
    if part is None:
        return 1.0
    return information(
        channel.space.n, part.outlier_probability, part.outlier_scale, part.student_dof
    )


def _diagonal(a: Float[Array, "... _ _"], b: Float[Array, "_ _"]) -> Float[Array, "... _ _"]:
    """The block-diagonal matrix of a, or of each of a stack, and b."""
    (n, k), (m, j) = a.shape[-2:], b.shape
    out = np.zeros((*a.shape[:-2], n + m, k + j))
    out[..., :n, :k], out[..., n:, k:] = a, b
    return out
