"""Where an environment has its MuJoCo model and data."""

import inspect
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from estbench.envs.errors import EnvError
from estbench.envs.parts import Path, at, walk

MODES = ("follow", "nominal")
_NAMES = (("model", "data"), ("mjModel", "mjData"), ("mj_model", "mj_data"))
_SKIPS = ("frame_skip", "n_substeps", "_n_sub_steps", "n_sub_steps")
_REMEDY = (
    "say where they are, as in EstimatedObservation(env, model=lambda env: env.robot.model, "
    "data=lambda env: env.robot.data); for a robot of your own use "
    "gym.make('estbench/Scenario-v0', scenario='robot.toml')"
)

Given = str | mujoco.MjModel | mujoco.MjData | Callable[..., Any] | Any


class Place:
    """Finds model and data of an environment, now or after it has made others.

    Args:
        env: the environment.
        model: `follow` or `nominal`, which say nothing of the place; or the model, an object that
            has it (dm_control's physics), or a function of the unwrapped environment, or of
            nothing, that returns one of these.
        data: likewise. Without both the attributes of the unwrapped environment are searched.

    Attributes:
        steps: physics steps of a step, where the environment says it; else None.

    Raises:
        EnvError: there is no model and data, or more than one.
    """

    def __init__(self, env: Any, model: Given = "follow", data: Given = None):
        base = env.unwrapped
        if isinstance(model, str):
            if model not in MODES:
                raise EnvError(
                    f"model is '{model}'; use 'follow', 'nominal', or where the model is"
                )
            model = None
        self._data = _function(data, "data")
        self._model = _function(model, "model")
        if data is None and model is None:
            self._model, self._data = _searched(base)
        found = None if self._data is None else _mujoco(self._data(base), mujoco.MjData)
        if found is None:
            what = "model= is given, but not data=" if data is None else "data= leads to no MjData"
            raise EnvError(f"{type(base).__name__}: {what}; {_REMEDY}")
        if not isinstance(data, Callable) and data is not None:
            self._data = _followed(base, found, self._data)
        if self._model is None:
            self._model = _model_of(base, found)
        elif model is not None and not isinstance(model, Callable):
            self._model = _followed(base, _mujoco(model, mujoco.MjModel), self._model)
        self.find(env)
        self.steps = _steps(base, self._data)

    def find(self, env: Any) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Model and data as they are now.

        Raises:
            EnvError: they are not there, or the model has no joint.
        """
        base = env.unwrapped
        assert self._data is not None
        data = _mujoco(self._data(base), mujoco.MjData)
        if self._model is not None:
            model = _mujoco(self._model(base), mujoco.MjModel)
        else:  # kept nowhere else
            model = None if data is None else data.model
        if model is None or data is None:
            what = "model= leads to no MjModel" if model is None else "data= leads to no MjData"
            raise EnvError(f"{type(base).__name__}: {what}; {_REMEDY}")
        if not model.nv:
            raise EnvError(f"{type(base).__name__}: its model has no joint, so there is no state")
        return model, data

    @property
    def usual(self) -> bool:
        """Whether the data are the attribute `data`."""
        return isinstance(self._data, _Attributes) and self._data.path == ("data",)

    def frame_skip(self, given: int | None) -> int:
        """Physics steps of a step: as given, or as the environment says it, or one.

        Raises:
            EnvError: it is no positive integer.
        """
        if given is None:
            return self.steps or 1
        if not isinstance(given, int | np.integer) or given < 1:
            raise EnvError(f"frame_skip is {given}; use an integer of at least 1")
        return int(given)

    def __getstate__(self) -> dict[str, Any]:
        """The functions.

        Raises:
            EnvError: one takes no argument, so that it would find the original's data.
        """
        for name in ("_model", "_data"):
            if isinstance(getattr(self, name), _Fixed):
                raise EnvError(
                    f"{name[1:]}= does not depend on the environment, so a copy would follow the "
                    f"original; give a function of it: {name[1:]}=lambda env: ..."
                )
        return vars(self)


class _Attributes:
    """The object at the end of a path of attributes."""

    def __init__(self, path: Path):
        self.path = path

    def __call__(self, base: Any) -> Any:
        return at(base, self.path)


class _Fixed:
    """An object, or the result of a function without an argument, whatever the environment."""

    def __init__(self, found: Any):
        self._found = found

    def __call__(self, base: Any) -> Any:
        return self._found() if inspect.isroutine(self._found) else self._found


def _function(given: Given, name: str) -> Callable[[Any], Any] | None:
    """A function of the unwrapped environment."""
    if given is None:
        return None
    if _mujoco(given, mujoco.MjModel) is not None or _mujoco(given, mujoco.MjData) is not None:
        return _Fixed(given)
    if not callable(given):
        raise EnvError(f"{name}= is {type(given).__name__}, which has no MuJoCo {name}; {_REMEDY}")
    try:
        inspect.signature(given).bind(None)
    except TypeError:
        return _Fixed(given)
    return given


def _followed(base: Any, found: Any, otherwise: Any) -> Callable[[Any], Any]:
    """The path to a given object, so that a copy of the environment is found likewise."""
    for path, value in walk(base):
        if value is found:
            return _Attributes(path)
    return otherwise


def _mujoco(value: Any, kind: type) -> Any:
    """The MjModel or MjData that a value is, wraps or has; None for none."""
    name = "model" if kind is mujoco.MjModel else "data"
    seen = 0
    while value is not None and not isinstance(value, kind) and seen < 3:
        inner = None
        for attribute in ("ptr", name, f"_{name}"):
            inner = getattr(value, attribute, None)
            if inner is not None and not callable(inner):
                break
        value, seen = inner, seen + 1
    return value if isinstance(value, kind) else None


def _searched(base: Any) -> tuple[Callable[[Any], Any] | None, Callable[[Any], Any]]:
    """Functions that find model and data, which the environment has somewhere.

    Raises:
        EnvError: there is none, or it is not clear which.
    """
    for model, data in _NAMES:
        there = getattr(base, model, None), getattr(base, data, None)
        if isinstance(there[0], mujoco.MjModel) and isinstance(there[1], mujoco.MjData):
            return _Attributes((model,)), _Attributes((data,))
    found = [(path, value) for path, value in walk(base) if isinstance(value, mujoco.MjData)]
    different = {value._address: path for path, value in reversed(found)}
    if not different:
        raise EnvError(
            f"{type(base).__name__} is not a MuJoCo environment: neither it nor a part of it "
            f"has a `model` (mujoco.MjModel) and a `data` (mujoco.MjData); {_REMEDY}"
        )
    if len(different) > 1:
        places = ", ".join(sorted(".".join(path) for path in different.values()))
        raise EnvError(
            f"{type(base).__name__} has several MuJoCo data: {places}; say which, as in "
            f"EstimatedObservation(env, data=lambda env: env.{'.'.join(found[0][0])})"
        )
    path, value = found[0]
    return _model_of(base, value), _Attributes(path)


def _model_of(base: Any, data: mujoco.MjData) -> Callable[[Any], Any] | None:
    """A function that finds the model of some data in the environment, if it is there."""
    for path, value in walk(base):
        if isinstance(value, mujoco.MjModel) and value._address == data.model._address:
            return _Attributes(path)
    return None


def _steps(base: Any, data: Any) -> int | None:
    """Physics steps of a step as the environment, or an owner of the data, says it."""
    path = data.path if isinstance(data, _Attributes) else ()
    owners = [at(base, path[:k]) for k in range(max(len(path), 1))]
    for owner in owners:
        for name in _SKIPS:
            value = getattr(owner, name, None)
            if isinstance(value, int | np.integer) and value > 0:
                return int(value)
    return None
