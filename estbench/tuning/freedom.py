"""From what the user frees to parameters: where each stands, its value now, its default range."""

import inspect
from collections.abc import Sequence
from typing import Any

import numpy as np

from estbench.errors import StudyError
from estbench.estimators import registry
from estbench.experiment.prepared import Setup
from estbench.robots import parameters as robots
from estbench.robots.disturbance import axis_names
from estbench.spaces.patterns import expand
from estbench.study import keys
from estbench.tuning.parameters import Free, Kind, Parameter

RANGES = {
    "process_noise_scale": 1e4, "measurement_noise_scale": 1e4, "process_noise": 1e4,
    "channels": 1e3, "set": 5.0, "inflate": 100.0, "setting": 100.0, "whole": 10.0,
}  # fmt: skip
"""Default range of each kind of parameter, as a factor on both sides of the value before."""


def parameters(prepared: Setup, label: str, free: Sequence[Free]) -> tuple[Parameter, ...]:
    """The free parameters of an estimator.

    Args:
        prepared: the experiment before the tuning.
        label: of the estimator that is tuned.
        free: what is free.

    Raises:
        StudyError: a key does not exist, is not free to vary, or needs a range.
    """
    if not free:
        raise StudyError("nothing is free; name a parameter, e.g. filter.process_noise_scale")
    out = [_parameter(prepared, label, one) for one in free]
    for i, one in enumerate(out):
        if one.names in [other.names for other in out[:i]]:
            raise StudyError(f"'{one.key}' is named twice; free each parameter once")
    return tuple(out)


def _parameter(prepared: Setup, label: str, free: Free) -> Parameter:
    own = _own(prepared, label, free.key)
    names = tuple(own) if own[0] == "log" else ("estimators", label, *own)
    if free.choices:
        return Parameter(names, free.key, _value(prepared, label, own), kind="choice",
                         choices=free.choices)  # fmt: skip
    value = _value(prepared, label, own)
    if isinstance(value, bool) or not isinstance(value, int | float | np.floating | np.integer):
        shown = "not set" if value is None else repr(value)
        hint = "name it in the scenario first" if value is None else "give its choices, KEY=A,B"
        raise StudyError(f"'{free.key}' is {shown}, which is no number to tune; {hint}")
    kind: Kind = "smooth"
    if own[0] != "log" and own[-1] in ("latency", "window"):
        kind = "stepped"
    elif own[0] not in ("filter", "start", "log") and isinstance(value, int | np.integer):
        kind = "whole"
    return _ranged(free, names, own, kind, value if kind == "whole" else float(value))


def _ranged(free: Free, names: keys.Names, own: Sequence[str], kind: Kind, value: Any) -> Parameter:
    """The parameter with its range and scale."""
    low, high = free.low, free.high
    if low is None or high is None:
        if not value > 0:
            raise StudyError(
                f"'{free.key}' is {value:g}, which gives no range; give one, {free.key}=LOW:HIGH"
            )
        if kind == "stepped":
            low, high = 0.0, 3.0 * value
        else:
            factor = RANGES[_family(own, kind)]
            low, high = value / factor, value * factor
            if kind == "whole":
                low, high = max(1.0, round(low)), float(round(high))
    log = low > 0 and kind != "stepped"
    start = min(max(value, low), high)
    return Parameter(names, free.key, start, float(low), float(high), log, kind)


def _family(own: Sequence[str], kind: Kind) -> str:
    if kind == "whole":
        return "whole"
    if own[0] == "start":
        return "inflate"
    return own[1] if own[0] == "filter" and own[1] in RANGES else "setting"


def _own(prepared: Setup, label: str, key: str) -> Sequence[str]:
    """The parts of the key within the table of the estimator.

    Raises:
        StudyError: it belongs to the truth, or to another estimator.
    """
    names: Sequence[str] = keys.parse(key)
    if names[0] == "estimators":
        if list(names[1:2]) != [label] or len(names) < 3:
            raise StudyError(f"'{key}' is not of '{label}', the estimator that is tuned")
        names = list(names)[2:]
    first, *rest = names
    if first == "log" and prepared.timeline is not None:
        return _of_log(key, names)
    sections = type(prepared.scenario).model_fields
    if first in sections and first not in ("filter", "start"):
        raise StudyError(
            f"'{key}' is not free to vary: it changes the truth or the readings; free what the "
            "filter believes of it, filter.process_noise..., filter.channels... or filter.set..."
        )
    if not rest and first in ("filter", "start"):
        raise StudyError(f"'{key}' is a table; name one of its keys, e.g. {key}.inflate")
    return names


def _of_log(key: str, names: Sequence[str]) -> Sequence[str]:
    """The parts of a key of `[log]`, of a number that does not change how likely a reading is.

    Raises:
        StudyError: it is another key.
    """
    known = [("log", "delay"), ("log", "channels", "offset"), ("log", "channels", "latency"),
             ("log", "controls", "offset"), ("log", "controls", "scale")]  # fmt: skip
    if (*names[:2], *names[3:]) not in known and tuple(names) not in known:
        raise StudyError(
            f"'{key}' is not free to vary; of [log] these are: delay, the offset and latency of "
            "channels.NAME, the offset and scale of controls.NAME"
        )
    return names


def _value(prepared: Setup, label: str, own: Sequence[str]) -> Any:
    """The value before the tuning; None where there is none.

    Raises:
        StudyError: the key names what does not exist.
    """
    side = prepared.believed[label]
    if own[0] == "log":
        return keys.value_of(prepared.scenario.model_dump(), tuple(own))
    if own[0] == "start":
        return _of_table(prepared.start(label).model_dump(), own[1:], 1.0, prepared.space.names)
    if own[0] != "filter":
        return _of_setting(prepared, label, own)
    section = side.section
    if tuple(own[1:3]) == ("process_noise", "density"):
        density = np.diag(side.disturbance.density) / section.process_noise_scale
        names = axis_names(prepared.plant.model, prepared.space, side.disturbance.kind)
        return _mean(density, names, own[3:], f"filter.{own[1]}.density")
    if own[1] == "channels" and len(own) > 3 and own[3] == "noise":
        channel = next((c for c in side.channels if c.name == own[2]), None)
        if channel is None:
            known = ", ".join(c.name for c in side.channels)
            raise StudyError(f"'{keys.show(tuple(own))}': no channel '{own[2]}' (known: {known})")
        std = np.sqrt(np.diag(channel.cov) / section.measurement_noise_scale)
        assert channel.measurand is not None
        axes = [n.removeprefix(f"{own[2]}.") for n in channel.measurand.space.names]
        return _mean(std, axes, own[4:], f"filter.channels.{own[2]}.noise")
    if own[1] == "channels" and list(own[3:]) == ["latency"]:
        true = {c.name: c.timing.latency for c in prepared.channels}
        given = keys.value_of(section.model_dump(), tuple(own[1:]))
        step = float(prepared.plant.model.opt.timestep)
        return true.get(own[2], 0) * step if given is None else given
    if own[1] == "set" and len(own) == 3:
        field, rows = robots.parameter(side.robot, own[2], "filter.set")
        return float(np.mean(getattr(side.robot, field)[rows]))
    known = type(section).model_fields
    if own[1] not in known:
        raise StudyError(f"'{keys.show(tuple(own))}': unknown key (known: {', '.join(known)})")
    return keys.value_of(section.model_dump(), tuple(own[1:]))


def _of_setting(prepared: Setup, label: str, own: Sequence[str]) -> Any:
    """The value of a setting, or its default in the signature of the class."""
    table = prepared.settings(label)
    given = keys.value_of(table, tuple(own))
    if given is not None or len(own) > 1:
        return given
    if own[0] == "type":
        return table.get("type", label)
    signature = inspect.signature(registry.resolve(str(table.get("type", label)))).parameters
    known = [name for name in signature if name not in ("model", "self")]
    if own[0] not in signature:
        raise StudyError(f"'{own[0]}': {label} has no such setting (known: {', '.join(known)})")
    default = signature[own[0]].default
    return None if default is inspect.Parameter.empty else default


def _of_table(
    table: dict[str, Any], own: Sequence[str], default: float, names: Sequence[str]
) -> Any:
    """A number of a section whose value may be given per name."""
    if own[0] not in table:
        raise StudyError(f"'start.{own[0]}': unknown key (known: {', '.join(table)})")
    value = table[own[0]]
    if len(own) == 1 or value is None:
        return value
    return _mean(expand(value, names, f"start.{own[0]}", default), names, own[1:], "start")


def _mean(values: Any, names: Sequence[str], pattern: Sequence[str], where: str) -> float:
    """The geometric mean of the positive values whose names match; 0 where none is positive."""
    chosen = np.ones(len(names), bool)
    if pattern:
        chosen = expand({pattern[0]: 1.0}, names, where) > 0
    positive = np.asarray(values)[chosen & (np.asarray(values) > 0)]
    return float(np.exp(np.log(positive).mean())) if len(positive) else 0.0
