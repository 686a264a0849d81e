"""Some rows of nested values of any make: beliefs, the memory of sensors."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from estbench.errors import SelectionError
from estbench.shapes import Ints, Mask


def chosen(rows: Ints, count: int) -> Mask:
    """Rows by their numbers as a mask `(count,)`."""
    mask = np.zeros(count, bool)
    mask[rows] = True
    return mask


def select(mask: Mask, new: Any, old: Any, what: str = "belief") -> Any:
    """`new` in the rows of a mask and `old` in the others, for a belief of any make.

    Arrays with a leading row axis are mixed; dataclasses, tuples and mappings part by part. What
    only one of them has (a Jacobian or points kept from the last step) is dropped, as the
    estimators make such things anew.

    Raises:
        SelectionError: a part is neither a row's own nor the same in both.
    """
    if new is old:
        return old
    if new is None or old is None:
        return None
    if isinstance(new, np.ndarray) and isinstance(old, np.ndarray):
        if new.shape == old.shape and new.shape[:1] == mask.shape:
            return np.where(mask.reshape(-1, *[1] * (new.ndim - 1)), new, old)
        if np.array_equal(new, old):
            return old
    elif dataclasses.is_dataclass(new) and type(new) is type(old):
        parts = {
            f.name: select(mask, getattr(new, f.name), getattr(old, f.name), f"{what}.{f.name}")
            for f in dataclasses.fields(new)
            if f.init
        }
        return dataclasses.replace(old, **parts)
    elif isinstance(new, Mapping) and isinstance(old, Mapping):
        return {k: select(mask, new[k], old[k], f"{what}.{k}") for k in new if k in old}
    elif isinstance(new, tuple | list) and type(new) is type(old) and len(new) == len(old):
        parts = [select(mask, a, b, f"{what}[{i}]") for i, (a, b) in enumerate(zip(new, old))]
        return type(new)(*parts) if hasattr(new, "_fields") else type(new)(parts)
    elif type(new) is type(old) and new == old:
        return old
    raise SelectionError(
        f"{what} ({type(old).__name__}) is not kept row by row, so one row cannot start anew; use "
        "arrays whose first axis is the run, in a dataclass, tuple or dict"
    )
