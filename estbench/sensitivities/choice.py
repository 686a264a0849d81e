"""Which parameters the user means: patterns of their keys, other keys, and ranges."""

import json
from collections.abc import Sequence
from dataclasses import replace
from fnmatch import fnmatchcase

from estbench.errors import StudyError, did_you_mean
from estbench.scenario.schema import Scenario
from estbench.sensitivities.parameter import Parameter
from estbench.study import axes, keys
from estbench.study.axes import Range


def chosen(
    found: Sequence[Parameter], texts: Sequence[str], scenario: Scenario
) -> tuple[Parameter, ...]:
    """The parameters that any of the texts names, in the order of `found`; all without texts.

    Args:
        found: those of the scenario.
        texts: `PATTERN`, the key of another number of the scenario, or either of them as
            `KEY=lin:LOW:HIGH` or `KEY=log:LOW:HIGH`.
        scenario: for the other numbers.

    Raises:
        StudyError: a text names no number, or a range is wrong.
    """
    out = {p.names: p for p in found} if not texts else {}
    for text in texts:
        pattern, equals, spec = text.partition("=")
        pattern = pattern.strip()
        given = _range(pattern, spec) if equals else None
        hits = [p for p in found if fnmatchcase(p.key, pattern)]
        for p in hits or [_other(found, pattern, scenario, given)]:
            if given is not None and not p.single:
                p = _alone(p)
            out[p.names] = p if given is None else replace(p, given=given)
    return tuple(out.values())


def _alone(p: Parameter) -> Parameter:
    """Several numbers that are given as one.

    Raises:
        StudyError: they differ, so that one range does not say what each is.
    """
    values = [v for v in p.value if not isinstance(v, list)]
    if len(values) < len(p.value) or any(v != values[0] for v in values):
        raise StudyError(
            f"--key {p.key} is several numbers, which vary by one factor; give no range"
        )
    return replace(p, value=values[0])


def _range(pattern: str, spec: str) -> Range:
    _, given = axes.parse(f"{json.dumps(pattern)}={spec}") if spec else ((), ())
    if not isinstance(given, Range):
        raise StudyError(
            f"--key {pattern}={spec} is no range; use {pattern}=lin:LOW:HIGH or "
            f"{pattern}=log:LOW:HIGH"
        )
    return given


def _other(
    found: Sequence[Parameter], key: str, scenario: Scenario, given: Range | None
) -> Parameter:
    """A number of the scenario that is none of the parameters.

    Raises:
        StudyError: there is none, or it is not positive and has no range.
    """
    known = [p.key for p in found]
    part = any(key in name for name in known)
    hint = f"; use a pattern, '*{key}*'" if part else did_you_mean(key, known)
    unknown = f"--key '{key}' matches no parameter{hint}"
    try:
        names = keys.parse(key)
    except StudyError:
        raise StudyError(unknown) from None
    value = keys.value_of(scenario.model_dump(exclude_none=True), names)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise StudyError(unknown)
    if names[0] in ("simulation", "consistency"):
        raise StudyError(f"--key '{key}' is not of the filter or the hardware; vary another number")
    if not value > 0 and given is None:
        raise StudyError(
            f"--key '{key}' is {value:g}, which has no relative change; give a range, "
            f"{key}=lin:LOW:HIGH"
        )
    side = "filter" if names[0] in ("filter", "start", "estimators") else "hardware"
    kind = "count" if isinstance(value, int) else "smooth"
    return Parameter(key, names, side, value, kind=kind)
