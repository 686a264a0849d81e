"""Objects that a user names as `module:name`: a class of estimators, a function of a scenario."""

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from estbench.errors import EstimatorError, ScenarioError, did_you_mean, user_error_location


def load_module(module: str, what: str) -> Any:
    """Import a user's module from the current folder or the import path.

    Raises:
        EstimatorError: it cannot be imported.
    """
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)
    if module.endswith(".py") and Path(module).is_file():
        name = ".".join(Path(module).with_suffix("").parts)
        raise EstimatorError(f"{what}: '{module}' is a file; name its module, '{name}'")
    try:
        return importlib.import_module(module)
    except Exception as error:  # a user's module may raise anything
        raise EstimatorError(
            f"{what}: cannot import '{module}': {user_error_location(error)}"
        ) from None


def function(target: str, where: str) -> Callable[..., Any]:
    """The function `module:name`, from the current folder or the import path.

    Raises:
        ScenarioError: there is no such function.
    """
    module, colon, name = target.partition(":")
    if not (colon and module and name):
        raise ScenarioError(f"{where} is {target!r}; use 'module:function'")
    try:
        loaded = load_module(module, where)
    except EstimatorError as error:
        raise ScenarioError(str(error)) from None
    found = getattr(loaded, name, None)
    if not callable(found):
        public = [n for n, v in vars(loaded).items() if callable(v) and not n.startswith("_")]
        raise ScenarioError(
            f"{where}: module {module} has no function '{name}'{did_you_mean(name, public)}"
        )
    return found
