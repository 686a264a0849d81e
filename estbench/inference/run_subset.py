"""Some runs of a belief, so that none pays for what arrives in the others."""

from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estbench.shapes import Bool, Int, Mask

RunIndex = slice | Int[NDArray[np.intp], " _"]
"""Indices of runs, or `ALL`."""
ALL = slice(None)

DIVISIBLE = {"mean", "cov", "factor", "fault", "keys", "counter"}
"""Fields that are known to have a leading run axis."""


def some(belief: Any, chosen: Bool[Mask, " run"]) -> RunIndex:
    """The rows to work on where those chosen are to change.

    All, where it would be most of them, or where the belief cannot be divided: it may share numbers
    between runs.
    Otherwise those chosen, some of them repeated: their count is a power of two, so that a model
    meets few counts of rows (MuJoCo keeps memory for each).
    """
    rows = np.flatnonzero(chosen)
    count = 1 << max(0, len(rows) - 1).bit_length()
    if 8 * count > 5 * len(chosen) or not _divisible(belief):
        return ALL
    return np.resize(rows, count) if len(rows) else rows


def take(belief: Any, rows: RunIndex) -> Any:
    """The belief of some runs."""
    if isinstance(rows, slice):
        return belief
    return replace(belief, **{name: value[rows] for name, value in _parts(belief).items()})


def put(belief: Any, rows: RunIndex, part: Any) -> Any:
    """The belief with that of some runs replaced; repeated rows agree."""
    if isinstance(rows, slice):
        return part
    out = {}
    for name, value in _parts(belief).items():
        out[name] = value.copy()
        out[name][rows] = getattr(part, name)
    return replace(belief, **out)


def within(rows: RunIndex, inner: RunIndex) -> RunIndex:
    """Those of `rows` at the places `inner`."""
    if isinstance(rows, slice):
        return inner
    return rows if isinstance(inner, slice) else rows[inner]


def _parts(belief: Any) -> dict[str, NDArray[Any]]:
    """Its arrays by name."""
    values = {f.name: getattr(belief, f.name) for f in fields(belief)}
    return {name: value for name, value in values.items() if value is not None}


def _divisible(belief: Any) -> bool:
    """Whether every number of the belief belongs to one run."""
    return is_dataclass(belief) and _parts(belief).keys() <= DIVISIBLE
