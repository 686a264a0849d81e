"""Conventions of Gymnasium's vector environments: seeds, masks and infos of each row."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from estbench.envs.errors import EnvError
from estbench.shapes import Array, Mask

MODES = tuple(mode.value for mode in AutoresetMode) + tuple(AutoresetMode)


def row_seeds(seed: int | Sequence[int | None] | None, rows: int) -> list[int | None]:
    """One seed per row: s + i for an integer s.

    Raises:
        EnvError: a list of another length.
    """
    if seed is None:
        return [None] * rows
    if isinstance(seed, int | np.integer):
        return [int(seed) + i for i in range(rows)]
    if len(seed) != rows:
        raise EnvError(f"seed has {len(seed)} values; expected one per row, {rows}, or an integer")
    return list(seed)


def reset_mask(options: dict[str, Any] | None, rows: int) -> Mask:
    """The rows that `options["reset_mask"]` names; all without it.

    Raises:
        EnvError: it is no array of `rows` booleans, or all are False.
    """
    mask = (options or {}).get("reset_mask")
    if mask is None:
        return np.ones(rows, bool)
    if not isinstance(mask, np.ndarray) or mask.dtype != bool or mask.shape != (rows,):
        shape = f"{mask.dtype} {mask.shape}" if isinstance(mask, np.ndarray) else repr(mask)
        raise EnvError(f"reset_mask is {shape}; expected a numpy array of {rows} booleans")
    if not mask.any():
        raise EnvError("reset_mask is False everywhere; name a row to reset, or do not call reset")
    return mask.copy()


def vector_info(info: dict[str, Array], mask: Mask) -> dict[str, Any]:
    """Infos as in Gymnasium's vector environments: `_key` marks the rows that have `key`."""
    out: dict[str, Any] = {}
    for key, values in info.items():
        out[key], out[f"_{key}"] = values, mask.copy()
    return out


def add_final(info: dict[str, Any], over: Mask, observations: Array, final: dict[str, Any]) -> None:
    """Add `final_obs` and `final_info` of the rows that ended now (same-step autoreset)."""
    last = np.full(len(over), None, dtype=object)
    for row in np.flatnonzero(over):
        last[row] = observations[row].copy()
    info |= {"final_obs": last, "_final_obs": over.copy()}
    info |= {"final_info": final, "_final_info": over.copy()}
