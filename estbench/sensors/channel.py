"""Sensors: which channels a scenario uses, and what each is: source, noise, flaws, timing."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import mujoco
import numpy as np
from numpy.typing import NDArray

from estbench.errors import ScenarioError, did_you_mean
from estbench.robots import layout
from estbench.robots.measurement import Measurand
from estbench.scenario.schema import BelievedChannelSection, ChannelSection
from estbench.sensors import datasheet, measurands, schedules
from estbench.sensors.imperfections import Imperfections
from estbench.sensors.timing import MjcfTiming, Timing
from estbench.shapes import Array
from estbench.spaces.manifold import Manifold

_ADD = "add <sensor> elements, or [channels.NAME] add = {type = 'jointpos', object = 'JOINT'}"


@dataclass(frozen=True, eq=False)
class Channel:
    """One sensor as it is on the robot, or several taken together, or a function of the state.

    Attributes:
        name: the MuJoCo sensor's name, or the scenario's for what is not one sensor.
        measurand: what it reads, without noise.
        sensors: names of the MuJoCo sensors it reads; none for a function.
        kind: type of the sensor(s), or `function`.
        cov: R `(m, m)`; where a schedule gives R itself, that of t = 0.
        columns: where the reading stands in sensordata; none for a function.
        timing: rate, phase, jitter, latency.
        imperfections: biases, quantization, faults, ...; None for white noise only.
        schedule: factor on the noise's std, or R itself, over time; or None.
    """

    name: str
    measurand: Measurand
    sensors: tuple[str, ...]
    kind: str
    cov: Array
    columns: NDArray[np.intp]
    timing: Timing
    imperfections: Imperfections | None = None
    schedule: schedules.Schedule | None = None

    @property
    def space(self) -> Manifold:
        """The manifold of its reading; names and units."""
        return self.measurand.space

    @property
    def index(self) -> int:
        """The MuJoCo sensor of a channel that is one.

        Raises:
            ScenarioError: it is several together, or a function of the state.
        """
        if len(self.measurand.sensors) != 1 or self.measurand.axes is not None:
            raise ScenarioError(
                f"channels.{self.name} is no single MuJoCo sensor, which is all that this knows"
            )
        return self.measurand.sensors[0]

    @cached_property
    def factor(self) -> Array:
        """L with L Lᵀ = R; zero rows where the sensor is exact."""
        exact = np.diag(self.cov) == 0.0
        factor = np.sqrt(self.cov) if exact.any() else np.linalg.cholesky(self.cov)
        return factor.astype(np.float64)

    def noise_from(self, white: Array, t: float) -> Array:
        """Noise ~ N(0, R) `(..., m)` of readings due at t, s, from standard normals `(..., m)`."""
        factor, size = self.factor, None
        if self.schedule is not None:
            value = self.schedule.at(t)
            if np.ndim(value) == 2:
                factor = np.linalg.cholesky(value)
            else:
                size = value
        # A stack of small products: one large product could round by the count of rows.
        v = (factor @ white[..., None])[..., 0]
        return v if size is None else v * size


def build(
    model: mujoco.MjModel,
    sections: Mapping[str, ChannelSection],
    use: Sequence[str] | None,
    frame_skip: int,
    duration: float = 0.0,
    mjcf_timings: Mapping[str, MjcfTiming] | None = None,
    believed: Mapping[str, BelievedChannelSection] | None = None,
) -> tuple[list[Channel], list[str]]:
    """The channels in use, and notices about what was assumed.

    A sensor that is taken together with others is a channel of its own only where `use` names it.

    Args:
        model: the truth's model, with added sensors.
        sections: the scenario's `[channels.NAME]`.
        use: names in use, or None for all.
        frame_skip: physics steps of a filter step: the default period.
        duration: of a run, s; schedules must last as long.
        mjcf_timings: name -> the MJCF's own rhythm of a sensor with a history.
        believed: the scenario's `[filter.channels.NAME]`; a channel whose R is given there may be
            free of noise.

    Raises:
        ScenarioError: a name that is no sensor, no sensor at all, a rate that does not fit.
        CovarianceError, DimensionError: R is not positive definite or has the wrong size.
    """
    names = [layout.sensor_name(model, i) for i in range(model.nsensor)]
    channels, notices = [], _idle(sections, use)
    for name in _in_use(names, sections, use):
        section, where = sections.get(name, ChannelSection()), f"channels.{name}"
        measurand, kind = measurands.build(name, section, model, names)
        timing = _timing(
            section, where, model.opt.timestep, frame_skip,
            [(mjcf_timings or {}).get(names[i], MjcfTiming()) for i in measurand.sensors],
        )  # fmt: skip
        belief = (believed or {}).get(name, BelievedChannelSection())
        exact = belief.noise is not None or belief.cov is not None
        std = _per_axis(model, measurand, model.sensor_noise)
        schedule = schedules.build(
            section.schedule, measurand.space.n, duration, f"{where}.schedule"
        )  # fmt: skip
        constants = "noise", "noise_density", "cov"
        notices += schedules.unused(schedule, section, constants, where)
        cov, assumed = schedules.initial_covariance(schedule), np.zeros(measurand.space.n)
        if cov is None:
            cov, assumed = datasheet.covariance(
                section, where, measurand.space, std, timing.rate, exact
            )
        if assumed.any():
            guess = dict.fromkeys(
                f"{s:g} {unit}" for s, unit in zip(assumed, measurand.space.units) if s
            )
            notices.append(f"{name}: no noise given; assuming {', '.join(guess)}")
        cutoff = _per_axis(model, measurand, mjcf_cutoff(model), np.inf)
        imperfections = datasheet.imperfections(section, where, measurand.space, cutoff)
        read = tuple(names[i] for i in measurand.sensors)
        columns = measurand.columns(model)
        channels.append(
            Channel(name, measurand, read, kind, cov, columns, timing, imperfections, schedule)
        )
    if not channels:
        raise ScenarioError(f"no sensor: the MJCF declares none in use; {_ADD}")
    return channels, notices


def _in_use(
    names: Sequence[str], sections: Mapping[str, ChannelSection], use: Sequence[str] | None
) -> list[str]:
    """The channels in use: sensors in the model's order, then what the scenario makes of them."""
    made = {name: s for name, s in sections.items() if s.of is not None or s.function is not None}
    known = [*names, *made]
    for name, section in made.items():
        if name in names:
            raise ScenarioError(f"channels.{name}: a sensor has this name; choose another")
        _check_names(f"channels.{name}.of", section.of or (), names)
    _check_names("sensors", use or (), known)
    _check_names("channels", sections, known)
    active = [
        name for name in known
        if sections.get(name, ChannelSection()).enabled and (use is None or name in use)
    ]  # fmt: skip
    if use is not None:
        return active
    members = {member for name in active if name in made for member in made[name].of or ()}
    return [name for name in active if name not in members]


def _check_names(where: str, wanted: Iterable[str], known: Sequence[str]) -> None:
    """Refuse names that no sensor has."""
    unknown = [f"no sensor '{n}'{did_you_mean(n, known)}" for n in wanted if n not in known]
    if unknown:
        none = "" if known else f"; the MJCF declares none: {_ADD}"
        raise ScenarioError(f"{where}: {'; '.join(unknown)}{none}")


def _idle(sections: Mapping[str, ChannelSection], use: Sequence[str] | None) -> list[str]:
    """A notice of the channels that the scenario makes and does not use."""
    idle = [
        name for name, s in sections.items()
        if use is not None and name not in use and (s.of or s.function or s.add)
    ]  # fmt: skip
    return [f"not in use, as `sensors` does not name it: {name}" for name in idle]


def mjcf_cutoff(model: mujoco.MjModel) -> Array:
    """Saturation that the MJCF gives each sensor `(nsensor,)`, infinite for none.

    MuJoCo clips neither unit vectors nor quaternions, and the cutoff of its distance sensors is
    how far they look.
    """
    kinds, types = mujoco.mjtDataType, mujoco.mjtSensor
    numbers = np.isin(model.sensor_datatype, [kinds.mjDATATYPE_REAL, kinds.mjDATATYPE_POSITIVE])
    looks = [types.mjSENS_GEOMDIST, types.mjSENS_GEOMNORMAL, types.mjSENS_GEOMFROMTO]
    clipped = numbers & ~np.isin(model.sensor_type, looks) & (model.sensor_cutoff > 0)
    return np.where(clipped, model.sensor_cutoff, np.inf)


def believed_covariance(channel: Channel, section: BelievedChannelSection) -> Array:
    """R as the filter believes it: its own, or the true one."""
    if section.noise is None and section.cov is None:
        return channel.cov
    given = ChannelSection(noise=section.noise, cov=section.cov)
    where, none = f"filter.channels.{channel.name}", np.zeros(channel.space.n)
    return datasheet.covariance(given, where, channel.space, none, 1.0)[0]


def _per_axis(
    model: mujoco.MjModel, measurand: Measurand, values: Array, default: float = 0.0
) -> Array:
    """A number a sensor `(nsensor,)` as one a tangent coordinate of the measurand `(m,)`."""
    if not measurand.sensors:
        return np.full(measurand.space.n, default)
    widths = [layout.sensor_space(model, [i]).n for i in measurand.sensors]
    out = np.repeat(values[list(measurand.sensors)], widths)
    return out if measurand.axes is None else out[list(measurand.axes)]


def _timing(
    section: ChannelSection,
    where: str,
    timestep: float,
    frame_skip: int,
    mjcf_timings: Sequence[MjcfTiming],
) -> Timing:
    """From the scenario, else from the MJCF."""
    if len(set(mjcf_timings)) > 1 and (section.rate is None or section.latency is None):
        raise ScenarioError(
            f"{where}.of: the MJCF gives its sensors different interval, delay or nsample; give "
            f"{where}.rate and {where}.latency"
        )
    timing = (mjcf_timings[0] if mjcf_timings else MjcfTiming()).timing(timestep, frame_skip)
    if section.rate is not None:
        period = _period(section.rate, timestep, f"{where}.rate")
        timing = replace(timing, period=period, phase=0, fractional=None, history=0)
    if section.phase is not None:
        # As MuJoCo does: a reading is taken at the first step that is not earlier.
        phase = int(np.ceil(section.phase / timestep - 1e-9))
        fractional = (float(max(phase, 1)), timing.fractional[1]) if timing.fractional else None
        timing = replace(timing, phase=phase, fractional=fractional)
    if section.latency is not None:
        timing = replace(timing, latency=section.latency / timestep, history=0)
    jitter = int(section.jitter / timestep + 1e-9)
    if section.jitter and not jitter:
        raise ScenarioError(
            f"{where}.jitter is {section.jitter:g} s, less than the timestep {timestep:g} s: "
            "a sampling time is a whole count of physics steps; use a smaller model.timestep"
        )
    return replace(timing, jitter=jitter, latency_std=section.latency_std / timestep)


def _period(rate: float, timestep: float, where: str) -> int:
    """Physics steps between the readings of a rate in Hz, which must be a whole count of them."""
    steps = 1.0 / rate / timestep
    period = round(steps)
    if period < 1 or abs(steps - period) > 1e-6 * max(1.0, steps):
        around = {max(1, math.ceil(steps)): None, max(1, math.floor(steps)): None}
        fitting = [f"{1 / (count * timestep):.8g}" for count in around]
        raise ScenarioError(
            f"{where} is {rate:g} Hz, a reading every {steps:.8g} physics steps of {timestep:g} s; "
            f"a whole count is needed: use {' or '.join(fitting)} Hz, or another model.timestep"
        )
    return period
