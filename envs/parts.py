"""The objects that an environment of another library consists of."""

import inspect
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np
from gymnasium import spaces

Path = tuple[str, ...]
"""Names of attributes, one after the other."""

_DEEPEST = 5
_MOST = 20_000
_OPAQUE = (type, np.ndarray, spaces.Space, mujoco.MjModel, mujoco.MjData, str, bytes)


def walk(base: Any) -> Iterator[tuple[Path, Any]]:
    """The values of the attributes, those of these values, and so on; the nearest first."""
    level: list[tuple[Path, Any]] = [((), base)]
    seen = {id(base)}
    for _ in range(_DEEPEST):
        below = []
        for path, owner in level:
            for name, value in list(getattr(owner, "__dict__", {}).items()):
                if id(value) in seen or len(seen) > _MOST:
                    continue
                seen.add(id(value))
                yield (*path, name), value
                if hasattr(value, "__dict__") and not _opaque(value):
                    below.append(((*path, name), value))
        level = below


def at(base: Any, path: Path) -> Any:
    """The object at a path."""
    for name in path:
        base = getattr(base, name)
    return base


def _opaque(value: Any) -> bool:
    return isinstance(value, _OPAQUE) or inspect.isroutine(value) or inspect.ismodule(value)
