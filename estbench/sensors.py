"""Sensors: which channels a scenario uses, their noise and rate, and when each delivers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from estbench import streams
from estbench.errors import CovarianceError, DimensionError, ScenarioError, did_you_mean
from estbench.linalg import is_positive_definite
from estbench.manifold import Manifold
from estbench.models import layout
from estbench.models.mujoco import sensor_columns, whole_steps
from estbench.scenario import ChannelSection

Array = NDArray[np.float64]

# Standard deviation assumed for a sensor that declares none, by unit: what a decent robot has.
DEFAULT_NOISE = {
    "rad": 0.01, "m": 0.01, "rad/s": 0.02, "m/s": 0.02, "m/s²": 0.1, "rad/s²": 0.5, "N": 0.5,
    "N m": 0.1, "T": 0.01, "pixel": 1.0, "s": 1e-3,
}  # fmt: skip
FALLBACK_NOISE = 0.01


@dataclass(frozen=True, eq=False)
class Channel:
    """One sensor as it is on the robot.

    Attributes:
        name: the MuJoCo sensor's name.
        index: its index in the model.
        space: the manifold of its reading; names and units.
        cov: R `(m, m)`.
        period: physics steps between readings.
        columns: where the reading stands in sensordata.
    """

    name: str
    index: int
    space: Manifold
    cov: Array
    period: int
    columns: NDArray[np.intp]

    def noise(self, seed: int, runs: Sequence[int], count: int) -> Array:
        """V ~ N(0, R) `(count, run, m)` of the run's first `count` readings."""
        white = streams.normals(seed, runs, f"sensor:{self.name}", count, self.space.n)
        return white @ np.linalg.cholesky(self.cov).T


@dataclass(frozen=True)
class Instant:
    """The end of one interval of the event loop.

    Attributes:
        start, end: s.
        nstep: physics steps between them.
        channels: names of the channels that deliver at `end`.
        control: whether the controller is asked at `start`.
    """

    start: float
    end: float
    nstep: int
    channels: tuple[str, ...]
    control: bool


def build(
    model: mujoco.MjModel,
    sections: Mapping[str, ChannelSection],
    use: Sequence[str] | None,
    frame_skip: int,
) -> tuple[list[Channel], list[str]]:
    """The channels in use, and notices about what was assumed.

    Args:
        model: the truth's model, with added sensors.
        sections: the scenario's `[channels.NAME]`.
        use: names in use, or None for all.
        frame_skip: physics steps of a filter step: the default period.

    Raises:
        ScenarioError: a name that is no sensor, no sensor at all, a rate that does not fit.
        CovarianceError, DimensionError: R is not positive definite or has the wrong size.
    """
    names = [layout.sensor_name(model, i) for i in range(model.nsensor)]
    for where, wanted in (("sensors", use or ()), ("channels", sections)):
        for name in wanted:
            if name not in names:
                raise ScenarioError(f"{where}: no sensor '{name}'{did_you_mean(name, names)}")
    channels, notices = [], []
    for index, name in enumerate(names):
        section = sections.get(name, ChannelSection())
        if (use is not None and name not in use) or not section.enabled:
            continue
        channel, notice = _channel(model, index, name, section, frame_skip)
        channels.append(channel)
        notices += notice
    if not channels:
        raise ScenarioError(
            "no sensor: the MJCF declares none in use; add <sensor> elements, or "
            "[channels.NAME] add = {type = 'jointpos', object = 'JOINT'}"
        )
    return channels, notices


def _channel(
    model: mujoco.MjModel, index: int, name: str, section: ChannelSection, frame_skip: int
) -> tuple[Channel, list[str]]:
    where = f"channels.{name}"
    space = layout.sensor_space(model, [index])
    notices = []
    if section.cov is not None:
        cov = np.asarray(section.cov, dtype=np.float64)
        if cov.shape != (space.n, space.n):
            raise DimensionError(
                f"{where}.cov has shape {cov.shape}; expected {(space.n, space.n)} "
                f"({', '.join(space.names)})"
            )
        if not is_positive_definite(cov):
            raise CovarianceError(f"{where}.cov (R) is not symmetric positive definite")
    else:
        given = model.sensor_noise[index] if section.noise is None else section.noise
        std = np.atleast_1d(np.asarray(given, dtype=np.float64))
        if section.noise is None and std[0] == 0.0:
            std = np.array([DEFAULT_NOISE.get(space.units[0], FALLBACK_NOISE)])
            notices.append(f"{name}: no noise given; assuming {std[0]:g} {space.units[0]}")
        if len(std) not in (1, space.n):
            raise DimensionError(f"{where}.noise has {len(std)} values; expected 1 or {space.n}")
        if not (std > 0).all():
            raise CovarianceError(
                f"{where}.noise is {std.min():g}; R must be positive definite, so use a std above 0"
            )
        cov = np.diag(np.broadcast_to(std, (space.n,)) ** 2)
    period = frame_skip
    if section.rate is not None:
        period = whole_steps(1.0 / section.rate, model.opt.timestep, f"{where}: 1/rate")
    return Channel(name, index, space, cov, period, sensor_columns(model, [index])), notices


def schedule(
    channels: Sequence[Channel], timestep: float, frame_skip: int, duration: float
) -> list[Instant]:
    """The instants of the event loop: every filter step and every reading, in order.

    The first reading of a channel comes one period after the start; the last filter step ends at
    the duration rounded to a whole count of them (at least one).
    """
    steps = max(1, round(duration / (timestep * frame_skip))) * frame_skip
    ticks = set(range(frame_skip, steps + 1, frame_skip))
    for channel in channels:
        ticks.update(range(channel.period, steps + 1, channel.period))
    out = []
    last = 0
    for tick in sorted(ticks):
        due = tuple(c.name for c in channels if tick % c.period == 0)
        out.append(
            Instant(last * timestep, tick * timestep, tick - last, due, last % frame_skip == 0)
        )
        last = tick
    return out
