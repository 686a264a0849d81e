"""Quantities as users write them: a number, a list, a table of glob patterns, a text."""

from collections.abc import Sequence
from fnmatch import fnmatchcase

import numpy as np

from estbench.errors import DimensionError, ScenarioError, did_you_mean
from estbench.shapes import Array, Float


def expand(
    value: float | Sequence[float] | dict[str, float],
    names: Sequence[str],
    what: str,
    default: float = 0.0,
) -> Float[Array, " name"]:
    """One number for each name.

    In a table a later pattern overrides an earlier one; a name that no pattern matches gets
    `default`.

    Args:
        value: one number for all names, a list of one number per name, or {pattern: number}.
        names: names of coordinates, actuators, ...
        what: name of the setting, for messages.
        default: value where no pattern matches.

    Raises:
        DimensionError: the list has another length.
        ScenarioError: a pattern matches no name, or a value is not a number.
    """
    try:
        return _expanded(value, names, what, default)
    except (TypeError, ValueError):
        raise ScenarioError(
            f"{what} is {value!r}; use a number, a list of numbers, or a table of name patterns"
        ) from None


def _expanded(
    value: float | Sequence[float] | dict[str, float],
    names: Sequence[str],
    what: str,
    default: float,
) -> Array:
    if isinstance(value, dict):
        out = np.full(len(names), float(default))
        unknown = []
        for pattern, number in value.items():
            hit = [fnmatchcase(name, pattern) for name in names]
            if not any(hit) and names:
                unknown.append(f"'{pattern}' matches none{did_you_mean(pattern, names)}")
            out[hit] = number
        if unknown:
            raise ScenarioError(f"{what}: {'; '.join(unknown)}")
        return out
    array = np.atleast_1d(np.asarray(value, dtype=np.float64))
    if array.ndim != 1 or len(array) not in (1, len(names)):
        raise DimensionError(
            f"{what} has {array.size} values; expected 1 or {len(names)} ({', '.join(names)})"
        )
    return np.broadcast_to(array, (len(names),)).copy()


def is_number(text: str) -> bool:
    """Whether Python reads a text as a number; `nan` and `inf` are numbers."""
    try:
        float(text)
    except ValueError:
        return False
    return True
