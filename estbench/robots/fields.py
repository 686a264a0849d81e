"""The numbers of a compiled model that its physics depends on: read, compared, given to another.

Somebody else may change them on the compiled model at any time (domain randomization, a door that
is moved). Names, colours, textures and keyframes are left out, and the settings of sensors.
"""

import copy
import ctypes
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from mujoco.introspect.structs import STRUCTS
from numpy.typing import NDArray

from estbench.errors import ScenarioError
from estbench.robots.flags import set_flags

Fields = dict[str, Any]
"""Field of a model -> value; those of its options as `opt.gravity`."""

_NO_PHYSICS = (
    "name", "text", "tuple", "paths", "mat_", "tex_", "skin_", "light_", "key_", "numeric_",
    "sensor_", "plugin", "signature",
)  # fmt: skip
_NO_PHYSICS_AT_END = ("_user", "_group", "_rgba", "_matid", "texcoord", "texcoordadr")
_ASSETS = ("mesh_", "hfield_", "bvh_", "oct_")
"""Fields that may be large: they are compared at the start of an episode only."""

_ARRAYS = [
    field.name
    for field in STRUCTS["mjModel"].fields
    if getattr(field, "array_extent", None)
    and not field.name.startswith(_NO_PHYSICS)
    and not field.name.endswith(_NO_PHYSICS_AT_END)
]
_OPTIONS = [field.name for field in STRUCTS["mjOption"].fields]
_GAP = 4096  # bytes of other fields that are compared too, rather than in two parts


def read(model: mujoco.MjModel) -> Fields:
    """All fields of a model that are not empty, as copies."""
    arrays = ((name, getattr(model, name)) for name in _ARRAYS)
    out: Fields = {name: array.copy() for name, array in arrays if array.size}
    for name in _OPTIONS:
        value = getattr(model.opt, name)
        out[f"opt.{name}"] = np.array(value) if isinstance(value, np.ndarray) else value
    return out


class Reference:
    """A model with which the fields of others are compared.

    Args:
        model: with the flags of `flags.set_flags`; it may have more sites than the others.
    """

    def __init__(self, model: mujoco.MjModel):
        fields = read(model)
        self._options = {name: v for name, v in fields.items() if name.startswith("opt.")}
        arrays = {name: v for name, v in fields.items() if name not in self._options}
        self._shapes = {name: value.shape for name, value in arrays.items()}
        self._bytes = {name: value.tobytes() for name, value in arrays.items()}

    def differences(self, fields: Mapping[str, Any]) -> Fields:
        """The fields that differ.

        Raises:
            ScenarioError: the sizes differ.
        """
        out: Fields = {}
        for name, value in fields.items():
            if name in self._options:
                here = self._options[name]
                if np.any(here != value) and not _flags_only(name, here, value):
                    out[name] = value
                continue
            shape = self._shapes.get(name, (0,))
            if name.startswith("site_"):
                shape = (min(len(value), shape[0]), *shape[1:])
            if shape != value.shape:
                raise ScenarioError(
                    f"{name} has the shape {value.shape} now, {shape} before: the robot is "
                    "another one; make a new filter for it"
                )
            raw = value.tobytes()
            if self._bytes[name][: len(raw)] != raw:
                out[name] = value
        lost = [n for n in self._shapes if n not in fields and not n.startswith("site_")]
        if lost:
            raise ScenarioError(
                f"{lost[0]} is gone: the robot is another one; make a new filter for it"
            )
        return out


def given(model: mujoco.MjModel, fields: Mapping[str, Any]) -> mujoco.MjModel:
    """A copy of a model with other values of some fields, with the flags of `flags.set_flags`."""
    out = copy.copy(model)
    for name, value in fields.items():
        if name.startswith("opt."):
            _set_option(out, name.removeprefix("opt."), value)
        else:
            target = getattr(out, name)
            target[: len(value)] = value
    set_flags(out)
    return out


class Looked:
    """Whether a model has changed since one looked at it last, in some microseconds.

    A model's arrays lie in one buffer, of which the words are compared.

    Args:
        model: it is kept alive.
    """

    def __init__(self, model: mujoco.MjModel):
        self.model = model
        arrays = {name: getattr(model, name) for name in _ARRAYS}
        options = [getattr(model.opt, name) for name in _OPTIONS]
        small = [o for o in options if isinstance(o, np.ndarray)]
        small += [a for name, a in arrays.items() if not name.startswith(_ASSETS)]
        self._often = _Words(small)
        self._seldom = _Words([a for name, a in arrays.items() if name.startswith(_ASSETS)])
        self._options = _numbers(model)

    def again(self, thorough: bool = False) -> bool:
        """Whether a word differs from the last look.

        Args:
            thorough: look at the shapes of meshes and terrain, and at the options that are one
                number, too.
        """
        differs = self._often.changed()
        if thorough:
            before, self._options = self._options, _numbers(self.model)
            differs |= before != self._options
            differs |= self._seldom.changed()
        return differs


class _Words:
    """The memory of some arrays of one model, and what it was."""

    def __init__(self, arrays: Sequence[NDArray[Any]]):
        places = sorted((a.ctypes.data, a.nbytes) for a in arrays if a.nbytes)
        self._views = [_words(start, stop) for start, stop in _merged(places)]
        self._last = [bytearray(view) for view in self._views]

    def changed(self) -> bool:
        # A bytearray is compared with the memory in place: a copy would empty the cache.
        if self._last == self._views:
            return False
        self._last = [bytearray(view) for view in self._views]
        return True


def _flags_only(name: str, here: Any, value: Any) -> bool:
    """Whether flags differ only where `flags.set_flags` sets them."""
    if name not in ("opt.disableflags", "opt.enableflags"):
        return False
    probe = mujoco.MjSpec().compile()
    _set_option(probe, name.removeprefix("opt."), value)
    set_flags(probe)
    return bool(getattr(probe.opt, name.removeprefix("opt.")) == here)


def _set_option(model: mujoco.MjModel, name: str, value: Any) -> None:
    if isinstance(value, np.ndarray):
        getattr(model.opt, name)[...] = value
    else:
        setattr(model.opt, name, value)


def _numbers(model: mujoco.MjModel) -> list[Any]:
    """The options that are one number."""
    values = [getattr(model.opt, name) for name in _OPTIONS]
    return [value for value in values if not isinstance(value, np.ndarray)]


def _merged(places: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Spans of addresses, those with a small gap between them as one."""
    out: list[tuple[int, int]] = []
    for start, length in places:
        if out and start - out[-1][1] <= _GAP:
            out[-1] = out[-1][0], start + length
        else:
            out.append((start, start + length))
    return out


def _words(start: int, stop: int) -> memoryview:
    """The memory between two addresses; the last word, which names follow, is taken whole."""
    count = -(-(stop - start) // 8)
    return memoryview((ctypes.c_uint64 * count).from_address(start)).cast("B")
