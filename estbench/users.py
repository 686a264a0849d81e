"""Functions that a user names as `module:function`."""

from collections.abc import Callable
from typing import Any

from estbench.errors import EstimatorError, ScenarioError, did_you_mean
from estbench.estimators.registry import load_module


def function(target: str, where: str) -> Callable[..., Any]:
    """The function `module:name`, looked for in the current folder too.

    Raises:
        ScenarioError: there is none.
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
