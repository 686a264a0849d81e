"""The channels of a scenario: measurand, noise, imperfections and timing of each."""

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
from estbench.robots.no_return import never_returns
from estbench.scenario.channels import ChannelSection
from estbench.scenario.filter import BelievedChannelSection
from estbench.sensors import datasheet, measurands, schedules
from estbench.sensors.imperfections import Imperfections
from estbench.sensors.timing import MjcfTiming, Timing
from estbench.shapes import Array, Float, Int
from estbench.spaces.manifold import Manifold
from estbench.spaces.patterns import expand

_ADD = "add <sensor> elements, or [channels.NAME] add = {type = 'jointpos', object = 'JOINT'}"


@dataclass(frozen=True, eq=False)
class Channel:
    """A sensor of the robot, several sensors as one measurement, or a function of the state.

    Attributes:
        name: name of the MuJoCo sensor, or that of the scenario's channel.
        measurand: what the channel measures: the noise-free reading.
        sensors: names of the MuJoCo sensors that the channel reads; empty for a function.
        kind: type of the sensor(s), or `function`.
        cov: R; where a schedule gives R itself, that of t = 0.
        columns: indices of the reading in sensordata; empty for a function.
        timing: rate, phase, jitter, latency.
        imperfections: biases, quantization, faults, ...; None for white noise only.
        schedule: factor on the std of the noise, or R itself, over time; None if constant.
    """

    name: str
    measurand: Measurand
    sensors: tuple[str, ...]
    kind: str
    cov: Float[Array, "m m"]
    columns: Int[NDArray[np.intp], " ny"]
    timing: Timing
    imperfections: Imperfections | None = None
    schedule: schedules.Schedule | None = None

    @property
    def space(self) -> Manifold:
        """The manifold of the reading, with names and units."""
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
    def factor(self) -> Float[Array, "m m"]:
        """L with L Lᵀ = R; its row is zero where the noise is zero."""
        exact = np.diag(self.cov) == 0.0
        factor = np.sqrt(self.cov) if exact.any() else np.linalg.cholesky(self.cov)
        return factor.astype(np.float64)

    def noise_from(self, white: Float[Array, "*any m"], t: float) -> Float[Array, "*any m"]:
        """Noise v ~ N(0, R(t)) from standard normals; t in s."""
        factor, size = self.factor, None
        if self.schedule is not None:
            value = self.schedule.at(t)
            if np.ndim(value) == 2:
                factor = np.linalg.cholesky(value)
            else:
                size = value
        # A stack of small products: the rounding of one large product depends on the row count.
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

    A sensor that is a member of another channel is a channel itself only if `use` names it.

    Args:
        model: the truth's model, with added sensors.
        sections: the scenario's `[channels.NAME]`.
        use: names of the channels in use, or None for all.
        frame_skip: physics steps per filter step: the default period.
        duration: length of each run, s; schedules must last as long.
        mjcf_timings: sensor -> timing that the MJCF gives, for sensors with a history.
        believed: the scenario's `[filter.channels.NAME]`; where R is given there, the true noise
            may be 0.

    Raises:
        ScenarioError: an unknown name, no sensor at all, or a rate that is no divisor of the
            physics rate.
        CovarianceError, DimensionError: R is not positive definite or has the wrong size.
    """
    names = [layout.sensor_name(model, i) for i in range(model.nsensor)]
    channels, notices = [], _unused(sections, use)
    noiseless: dict[str, list[str]] = {}
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
            described = dict.fromkeys(
                f"{s:g} {unit}" for s, unit in zip(assumed, measurand.space.units) if s
            )
            noiseless.setdefault(", ".join(described), []).append(name)
        cutoff = _per_axis(model, measurand, mjcf_cutoff(model), np.inf)
        imperfections = datasheet.imperfections(section, where, measurand.space, cutoff)
        read = tuple(names[i] for i in measurand.sensors)
        notices += [
            f"{name}: no reading arrives, as nothing computes the user sensor {names[i]}; describe "
            f"it by [channels.NAME] function = 'module:function'"
            for i in measurand.sensors
            if never_returns(model, i)
        ]
        columns = measurand.columns(model)
        channels.append(
            Channel(name, measurand, read, kind, cov, columns, timing, imperfections, schedule)
        )
    if not channels:
        raise ScenarioError(f"no sensor: the MJCF declares none in use; {_ADD}")
    return channels, notices + _assumed(noiseless)


def _assumed(noiseless: Mapping[str, Sequence[str]]) -> list[str]:
    """One notice for all channels of which nobody gives the noise: assumed noise -> channels."""
    if not noiseless:
        return []
    if len(noiseless) == 1:
        ((noise, names),) = noiseless.items()
        return [f"{_listed(names)}: no noise given; assuming {noise}"]
    parts = [f"{noise} ({_listed(names)})" for noise, names in noiseless.items()]
    return [f"no noise given; assuming {', '.join(parts)}"]


def _listed(names: Sequence[str], most: int = 4) -> str:
    """`a, b, c and 62 more`."""
    if len(names) <= most:
        return ", ".join(names)
    return f"{', '.join(names[: most - 1])} and {len(names) - most + 1} more"


def _in_use(
    names: Sequence[str], sections: Mapping[str, ChannelSection], use: Sequence[str] | None
) -> list[str]:
    """The channels in use: MuJoCo sensors in the model's order, then those of the scenario."""
    defined = {n: s for n, s in sections.items() if s.of is not None or s.function is not None}
    known = [*names, *defined]
    for name, section in defined.items():
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
    members = {member for name in active if name in defined for member in defined[name].of or ()}
    return [name for name in active if name not in members]


def _check_names(where: str, wanted: Iterable[str], known: Sequence[str]) -> None:
    """Refuse names that are not known.

    Raises:
        ScenarioError: unknown names; all are listed.
    """
    unknown = [f"no sensor '{n}'{did_you_mean(n, known)}" for n in wanted if n not in known]
    if unknown:
        none = "" if known else f"; the MJCF declares none: {_ADD}"
        raise ScenarioError(f"{where}: {'; '.join(unknown)}{none}")


def _unused(sections: Mapping[str, ChannelSection], use: Sequence[str] | None) -> list[str]:
    """One notice per channel that the scenario defines and does not use."""
    unused = [
        name for name, s in sections.items()
        if use is not None and name not in use and (s.of or s.function or s.add)
    ]  # fmt: skip
    return [f"not in use, as `sensors` does not name it: {name}" for name in unused]


def mjcf_cutoff(model: mujoco.MjModel) -> Float[Array, " sensor"]:
    """Saturation that the MJCF gives each sensor; infinite for none.

    MuJoCo clips neither unit vectors nor quaternions; the cutoff of its distance sensors is their
    range.
    """
    kinds, types = mujoco.mjtDataType, mujoco.mjtSensor
    numbers = np.isin(model.sensor_datatype, [kinds.mjDATATYPE_REAL, kinds.mjDATATYPE_POSITIVE])
    ranges = [types.mjSENS_GEOMDIST, types.mjSENS_GEOMNORMAL, types.mjSENS_GEOMFROMTO]
    clipped = numbers & ~np.isin(model.sensor_type, ranges) & (model.sensor_cutoff > 0)
    return np.where(clipped, model.sensor_cutoff, np.inf)


def believed_covariance(channel: Channel, section: BelievedChannelSection) -> Float[Array, "m m"]:
    """R as the filter believes it: that of `section`, else the true one."""
    if section.noise is None and section.cov is None:
        return channel.cov
    std = section.noise
    if isinstance(std, dict):
        true = np.sqrt(np.diag(channel.cov))
        axes = [name.removeprefix(f"{channel.name}.") for name in channel.space.names]
        own = expand(std, axes, f"filter.channels.{channel.name}.noise", np.nan)
        std = np.where(np.isnan(own), true, own).tolist()
    given = ChannelSection(noise=std, cov=section.cov)
    where, none = f"filter.channels.{channel.name}", np.zeros(channel.space.n)
    return datasheet.covariance(given, where, channel.space, none, 1.0)[0]


def _per_axis(
    model: mujoco.MjModel,
    measurand: Measurand,
    values: Float[Array, " sensor"],
    default: float = 0.0,
) -> Float[Array, " m"]:
    """Values per MuJoCo sensor as values per tangent coordinate."""
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
    """The timing of a channel: from the scenario, else from the MJCF."""
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
        # As in MuJoCo, a reading is sampled at the first step that is not earlier.
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
    """Physics steps between readings at a rate in Hz.

    Raises:
        ScenarioError: the count is not an integer.
    """
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
