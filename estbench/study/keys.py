"""Keys of a scenario as a study varies them: their names, their values, and a scenario with them.

A key is a dotted TOML key, as for `--set`. Names of coordinates and of model parameters contain
dots themselves; where such a name is the last part it needs no quotes:
`filter.set.body_mass.pole`, `filter.process_noise.density.hinge.vel`.
"""

import tomllib
from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from estbench.errors import StudyError
from estbench.scenario import reference
from estbench.scenario.mistakes import explain
from estbench.scenario.schema import Scenario

NAMED = (
    ("filter", "set"), ("filter", "process_noise", "density"), ("model", "set"), ("truth", "set"),
    ("process_noise", "density"), ("initial", "std"), ("start", "inflate"), ("start", "offset"),
)  # fmt: skip
"""Tables of numbers whose keys are names with dots."""

Names = tuple[str, ...]
"""The parts of a key."""


def parse(key: str) -> Names:
    """The parts of a dotted key.

    Raises:
        StudyError: it is no dotted TOML key.
    """
    try:
        table = tomllib.loads(f"{key} = 0")
    except tomllib.TOMLDecodeError:
        table = {}
    names: list[str] = []
    while isinstance(table, dict) and table:
        ((name, table),) = table.items()
        names.append(name)
    if not names:
        raise StudyError(f"'{key}' is not a dotted key; use one like filter.process_noise_scale")
    for prefix in NAMED:
        own = names[2:] if names[0] == "estimators" else names
        if tuple(own[: len(prefix)]) == prefix and len(own) > len(prefix) + 1:
            start = len(names) - len(own) + len(prefix)
            return (*names[:start], ".".join(names[start:]))
    return tuple(names)


def show(names: Names) -> str:
    """A key as its name in tables and stores: without quotes."""
    return ".".join(names)


def changed(scenario: Scenario, values: Mapping[Names, Any]) -> Scenario:
    """The scenario with some keys set.

    A table that is set where a number was, as in `start.inflate.hinge`, leaves the number to the
    other names.

    Raises:
        StudyError: a key does not exist, or a value does not fit it.
    """
    data = scenario.dumped()
    for names, value in values.items():
        if names[:2] == ("initial", "std"):
            data["initial"].setdefault("std", scenario.initial.std)
        _assign(data, names, value)
    try:
        made = Scenario.model_validate(data)
    except ValidationError as error:
        raise StudyError("; ".join(explain(error, Scenario))) from None
    return reference.settled(made)


def value_of(table: Mapping[str, Any], names: Names) -> Any:
    """The value of a key in nested tables; None where there is none."""
    found: Any = table
    for name in names:
        if not isinstance(found, Mapping):
            return None
        found = found.get(name)
    return found


def _assign(data: dict[str, Any], names: Names, value: Any) -> None:
    table = data
    for i, name in enumerate(names[:-1]):
        inner = table.get(name)
        if isinstance(inner, int | float) and not isinstance(inner, bool):
            inner = {"*": inner}
        if not isinstance(inner, dict | None):
            raise StudyError(
                f"'{show(names)}': {show(names[: i + 1])} is {inner!r}, which has no part "
                f"'{names[i + 1]}'; vary {show(names[: i + 1])} itself"
            )
        table[name] = dict(inner or {})
        table = table[name]
    table[names[-1]] = value
