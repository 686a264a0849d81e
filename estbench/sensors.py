"""Sensors: which channels a scenario uses, and what each is: noise, imperfections, timing."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from estbench import streams
from estbench.errors import CovarianceError, DimensionError, ScenarioError, did_you_mean
from estbench.imperfections import Imperfections
from estbench.linalg import is_positive_definite
from estbench.manifold import Manifold
from estbench.models import layout
from estbench.models.mujoco import sensor_columns, whole_steps
from estbench.scenario import BelievedChannelSection, ChannelSection
from estbench.schedules import Schedule
from estbench.timing import Timing

Array = NDArray[np.float64]

# Standard deviation assumed for a sensor that declares none, by unit: what a decent robot has.
DEFAULT_NOISE = {
    "rad": 0.01, "m": 0.01, "rad/s": 0.02, "m/s": 0.02, "m/s²": 0.1, "rad/s²": 0.5, "N": 0.5,
    "N m": 0.1, "T": 0.01, "pixel": 1.0, "s": 1e-3,
}  # fmt: skip
FALLBACK_NOISE = 0.01
ALLAN_PEAK = 0.6173
"""Peak of the Allan deviation of a Gauss-Markov process over its std (at 1.89 correlation times)."""
ALLAN_FLOOR = 0.6643
"""Floor of the Allan deviation over the bias instability, sqrt(2 ln 2/π) (IEEE Std 952)."""


@dataclass(frozen=True, eq=False)
class Channel:
    """One sensor as it is on the robot.

    Attributes:
        name: the MuJoCo sensor's name.
        index: its index in the model.
        space: the manifold of its reading; names and units.
        cov: R `(m, m)`.
        columns: where the reading stands in sensordata.
        timing: rate, phase, jitter, latency.
        part: biases, quantization, faults, ...; None for white noise only.
        schedule: factor on the noise's std over time, or None.
    """

    name: str
    index: int
    space: Manifold
    cov: Array
    columns: NDArray[np.intp]
    timing: Timing
    part: Imperfections | None = None
    schedule: Schedule | None = None

    @property
    def period(self) -> int:
        """Physics steps between readings."""
        return self.timing.period

    def noise(self, seed: int, runs: Sequence[int], count: int) -> Array:
        """White v ~ N(0, R) `(count, run, m)` of the run's first `count` readings."""
        white = streams.normals(seed, runs, f"sensor:{self.name}", count, self.space.n)
        return white @ np.linalg.cholesky(self.cov).T


def build(
    model: mujoco.MjModel,
    sections: Mapping[str, ChannelSection],
    use: Sequence[str] | None,
    frame_skip: int,
    duration: float = 0.0,
    native: Mapping[str, tuple[float, float, float]] | None = None,
) -> tuple[list[Channel], list[str]]:
    """The channels in use, and notices about what was assumed.

    Args:
        model: the truth's model, with added sensors.
        sections: the scenario's `[channels.NAME]`.
        use: names in use, or None for all.
        frame_skip: physics steps of a filter step: the default period.
        duration: of a run, s; schedules must last as long.
        native: name -> the MJCF's own (period, phase, delay), s, of sensors with nsample > 0.

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
        where = f"channels.{name}"
        space = layout.sensor_space(model, [index])
        timing = _timing(
            section, where, model.opt.timestep, frame_skip, (native or {}).get(name, (0.0,) * 3)
        )
        given, rate = float(model.sensor_noise[index]), 1.0 / (timing.period * timing.timestep)
        cov, assumed = _covariance(section, where, space, given, rate)
        if assumed:
            notices.append(f"{name}: no noise given; assuming {assumed:g} {space.units[0]}")
        part = _imperfections(section, where, space, float(model.sensor_cutoff[index]))
        schedule = Schedule.build(section.schedule, duration, f"{where}.schedule")
        columns = sensor_columns(model, [index])
        channels.append(Channel(name, index, space, cov, columns, timing, part, schedule))
    if not channels:
        raise ScenarioError(
            "no sensor: the MJCF declares none in use; add <sensor> elements, or "
            "[channels.NAME] add = {type = 'jointpos', object = 'JOINT'}"
        )
    return channels, notices


def believed_covariance(channel: Channel, section: BelievedChannelSection) -> Array:
    """R as the filter believes it: its own, or the true one."""
    if section.noise is None and section.cov is None:
        return channel.cov
    given = ChannelSection(noise=section.noise, cov=section.cov)
    return _covariance(given, f"filter.channels.{channel.name}", channel.space, 0.0, 1.0)[0]


def _covariance(
    section: ChannelSection, where: str, space: Manifold, native: float, rate: float
) -> tuple[Array, float]:
    """R `(m, m)`, and the std that had to be assumed (0 if none)."""
    if section.cov is not None:
        cov = np.asarray(section.cov, dtype=np.float64)
        if cov.shape != (space.n, space.n):
            raise DimensionError(
                f"{where}.cov has shape {cov.shape}; expected {(space.n, space.n)} "
                f"({', '.join(space.names)})"
            )
        if not is_positive_definite(cov):
            raise CovarianceError(f"{where}.cov (R) is not symmetric positive definite")
        return cov, 0.0
    assumed = 0.0
    if section.noise_density is not None:
        std = np.array([section.noise_density * np.sqrt(rate)])
    elif section.noise is not None:
        std = np.atleast_1d(np.asarray(section.noise, dtype=np.float64))
    else:
        if native == 0.0:
            native = assumed = DEFAULT_NOISE.get(space.units[0], FALLBACK_NOISE)
        std = np.array([native])
    if len(std) not in (1, space.n):
        raise DimensionError(
            f"{where}.noise has {len(std)} values; expected 1 or {space.n} ({', '.join(space.names)})"
        )
    if not (std > 0).all():
        raise CovarianceError(
            f"{where}.noise is {std.min():g}; R must be positive definite, so use a std above 0"
        )
    return np.diag(np.broadcast_to(std, (space.n,)) ** 2), assumed


def _timing(
    section: ChannelSection,
    where: str,
    timestep: float,
    frame_skip: int,
    native: tuple[float, float, float],
) -> Timing:
    """From the scenario, else from the MJCF's own (period, phase, delay)."""
    period, phase, delay = native
    if section.rate is not None:
        ticks = whole_steps(1.0 / section.rate, timestep, f"{where}: 1/rate")
    elif period > 0:
        ticks = max(1, round(period / timestep))
    else:
        ticks = frame_skip
    first = phase if section.phase is None else section.phase
    # MuJoCo rounds a phase up: a sample is computed at the first step that is not earlier.
    first_tick = int(np.ceil(first / timestep - 1e-9))
    latency = delay if section.latency is None else section.latency
    jitter = int(section.jitter / timestep + 1e-9)
    if section.jitter and not jitter:
        raise ScenarioError(
            f"{where}.jitter is {section.jitter:g} s, less than the timestep {timestep:g} s: "
            "a sampling time is a whole count of physics steps; use a smaller model.timestep"
        )
    return Timing(
        ticks, first_tick, jitter, latency / timestep, section.latency_std / timestep, timestep
    )


def _imperfections(
    section: ChannelSection, where: str, space: Manifold, cutoff: float
) -> Imperfections | None:
    """The section's imperfections, or None when there is none but white noise."""

    def axes(name: str) -> Array:
        value = np.atleast_1d(np.asarray(getattr(section, name), dtype=np.float64))
        if len(value) not in (1, space.n):
            raise DimensionError(f"{where}.{name} has {len(value)} values; expected 1 or {space.n}")
        return np.broadcast_to(value, (space.n,)).copy()

    if section.misalignment and space.n != 3:
        raise ScenarioError(f"{where}.misalignment needs a three-axis sensor; this has {space.n}")
    drift, step = axes("drift"), axes("quantization")
    if section.bias_instability is not None:
        drift = np.full(space.n, section.bias_instability * ALLAN_FLOOR / ALLAN_PEAK)
    if section.counts_per_revolution is not None:
        if space.units[0] != "rad":
            raise ScenarioError(
                f"{where}.counts_per_revolution is for angles, not {space.units[0]}"
            )
        step = np.full(space.n, 2 * np.pi / section.counts_per_revolution)
    limit = section.cutoff or (cutoff if cutoff > 0 else np.inf)
    part = Imperfections(
        bias=axes("bias"),
        walk=axes("bias_walk"),
        drift=drift,
        drift_time=section.drift_time,
        scale_factor=axes("scale_factor"),
        misalignment=section.misalignment,
        quantization=step,
        cutoff=np.full(space.n, limit),
        deadband=axes("deadband"),
        outlier_probability=section.outlier_probability,
        outlier_scale=section.outlier_scale,
        student_dof=section.student_dof or 0.0,
        dropout=section.dropout,
        dropout_length=section.dropout_length,
        stuck=section.stuck,
        stuck_length=section.stuck_length,
    )
    if not space.flat:
        for name in ("scale_factor", "misalignment", "quantization", "cutoff", "deadband"):
            if np.any(getattr(section, name)):
                raise ScenarioError(f"{where}.{name} has no meaning for a quaternion; remove it")
    ideal = not (part.normals(1) or part.uniforms() or part.constants(1))
    transfer = np.isfinite(limit) or part.quantization.any() or part.deadband.any()
    return None if ideal and not transfer else part
