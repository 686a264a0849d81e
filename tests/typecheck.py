"""The tests check the annotated shapes of estbench's arrays while it runs.

`install` puts a hook into the import system. In every module of `PACKAGES` it wraps the functions,
methods and dataclasses whose annotations have shapes (jaxtyping); the first `CALLS` calls of each
in every test function are checked by beartype. A call is checked when it has returned: where
estbench itself refuses an argument, its error is the one that is raised.

jaxtyping's own hook checks every call of every function, which doubles the time of the tests.
"""

import dataclasses
import functools
import inspect
import sys
import types
from collections.abc import Callable
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from typing import Any, get_args

from beartype import BeartypeConf
from beartype.door import die_if_unbearable
from jaxtyping import AbstractArray, jaxtyped

PACKAGES = (
    "spaces", "randomness", "models", "robots", "estimators", "smoothers", "sensors", "inference",
    "consistency", "simulation", "experiment",
)  # fmt: skip
CALLS = 4
CONF = BeartypeConf(is_pep484_tower=True)
"""An integer is a number, as for other type checkers."""
UNCHECKED = {"Innovation"}
"""What a user's estimator returns: `inference.innovations.check` refuses one that does not fit."""


class _Test:
    """The test function that runs, whatever its parameters."""

    name = ""


def begin_test(name: str) -> None:
    """Check the next calls of every function again, if another test function begins."""
    _Test.name = name


def install() -> None:
    """Check the packages from now on; they must not be imported yet."""
    prefixes = tuple(f"estbench.{package}" for package in PACKAGES)
    assert not any(name.startswith(prefixes) for name in sys.modules)
    sys.meta_path.insert(0, _Finder(prefixes))


class _Finder(MetaPathFinder):
    def __init__(self, prefixes: tuple[str, ...]):
        self._prefixes = prefixes

    def find_spec(self, fullname: str, path: Any, target: Any = None) -> ModuleSpec | None:
        if not fullname.startswith(self._prefixes):
            return None
        spec = PathFinder.find_spec(fullname, path, target)
        loader: Any = spec and spec.loader
        if loader is not None:
            run = loader.exec_module

            def exec_module(module: types.ModuleType) -> None:
                run(module)
                instrument(module)

            loader.exec_module = exec_module
        return spec


def instrument(module: types.ModuleType) -> None:
    """Wrap what the module defines."""
    for name, value in list(vars(module).items()):
        if getattr(value, "__module__", None) != module.__name__:
            continue
        if isinstance(value, types.FunctionType):
            setattr(module, name, checked(value))
        elif isinstance(value, type) and name not in UNCHECKED:
            _instrument_class(value)


def _instrument_class(cls: type) -> None:
    for name, value in list(vars(cls).items()):
        if isinstance(value, types.FunctionType):
            if not name.startswith("__") or (name == "__init__" and dataclasses.is_dataclass(cls)):
                setattr(cls, name, checked(value))
        elif isinstance(value, (classmethod, staticmethod)):
            setattr(cls, name, type(value)(checked(value.__func__)))
        elif isinstance(value, property) and isinstance(value.fget, types.FunctionType):
            setattr(cls, name, property(checked(value.fget), doc=value.__doc__))
        elif isinstance(value, functools.cached_property):
            value.func = checked(value.func)


def has_shape(annotation: Any) -> bool:
    """Whether an annotation has an array's shape in it."""
    if isinstance(annotation, type) and issubclass(annotation, AbstractArray):
        return True
    return any(has_shape(part) for part in get_args(annotation))


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with the shapes of its arguments and of its result checked."""
    hints = {name: hint for name, hint in inspect.get_annotations(function).items()
             if has_shape(hint)}  # fmt: skip
    if not hints:
        return function
    signature, where = inspect.signature(function), f"{function.__module__}.{function.__qualname__}"
    test, left = None, 0

    def wrapper(*args: Any, **kwargs: Any) -> Any:
        nonlocal test, left
        result = function(*args, **kwargs)
        if test != _Test.name:
            test, left = _Test.name, CALLS
        if left:
            left -= 1
            values = {**signature.bind(*args, **kwargs).arguments, "return": result}
            with jaxtyped("context"):  # pyright: ignore[reportGeneralTypeIssues]
                for name, hint in hints.items():
                    if name in values:
                        prefix = f"{where}: {name}: "
                        die_if_unbearable(values[name], hint, conf=CONF, exception_prefix=prefix)
        return result

    # Its frames pass for frames of estbench where a user's error is traced to its line.
    of_estbench = {**globals(), "__name__": function.__module__}
    code, closure = wrapper.__code__, wrapper.__closure__
    return functools.wraps(function)(types.FunctionType(code, of_estbench, closure=closure))
