"""Versions of the packages with which a store was begun and continued."""

import platform
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import metadata
from importlib.util import find_spec
from typing import Any

PACKAGES = ("estbench", "mujoco", "numpy", "scipy", "zarr", "xarray")
NUMERICAL = ("estbench", "mujoco", "numpy", "scipy", "numba")
"""The packages on which the numbers depend."""
EXTRAS = {"numba": "the extra fast (numba)"}
"""What a package is called that comes with an extra."""

version = cache(metadata.version)  # a package's metadata take 20 ms to read


def installed() -> dict[str, str]:
    """The installed versions."""
    return {name: version(name) for name in PACKAGES} | {"python": platform.python_version()}


def stamped() -> dict[str, str]:
    """The installed versions, and that of numba, which computes small covariances where it is."""
    return installed() | {"numba": version("numba") if find_spec("numba") else "absent"}


def known(attrs: Mapping[str, Any]) -> list[dict[str, str]]:
    """The versions in a store's attributes: the first ones, then those of resumes."""
    return [dict(v) for v in (attrs.get("versions", {}), *attrs.get("continued", ()))]


def mixed(versions: Sequence[Mapping[str, str]]) -> str | None:
    """A warning about a store whose numbers are of several versions; None for any other.

    Args:
        versions: from `known`.
    """
    said = []
    for name in NUMERICAL:
        first, *others = dict.fromkeys(v[name] for v in versions if name in v) or ("",)
        if others:
            name = EXTRAS.get(name, name)
            said.append(f"begun with {name} {first}, continued with {', '.join(others)}")
    if not said:
        return None
    return f"{'; '.join(said)}: the numbers may not be those of an uninterrupted run"
