"""Estimators by name (see `names`) or as `package.module:Name`: classes, and one on a model."""

import inspect
from collections.abc import Mapping
from typing import Any

from estbench.errors import EstbenchError, EstimatorError, did_you_mean, user_error_location
from estbench.estimators.names import BUILTIN, known
from estbench.estimators.protocol import Estimator
from estbench.models.protocol import Model
from estbench.plugins import load_module

METHODS = ("init", "predict", "update", "mean", "cov")


def resolve(name: str) -> type:
    """The class of a registered name or of `package.module:Name` (also from the current folder).

    Raises:
        EstimatorError: there is no such class, or it lacks a method of the protocol.
    """
    # The entry points come last: to read them takes 6 ms, and every batch builds its estimators.
    target = name if ":" in name else BUILTIN.get(name) or known().get(name, name)
    module, colon, attribute = target.partition(":")
    if not colon:
        raise EstimatorError(f"no estimator '{name}'{did_you_mean(name, known())}")
    found = getattr(load_module(module, f"estimator '{name}'"), attribute, None)
    if found is None:
        raise EstimatorError(f"estimator '{name}': module {module} has no '{attribute}'")
    missing = [method for method in METHODS if not callable(getattr(found, method, None))]
    if missing:
        raise EstimatorError(
            f"estimator '{name}' lacks the method(s) {', '.join(missing)}; an estimator has "
            f"{', '.join(METHODS)}"
        )
    return found


def create(label: str, settings: Mapping[str, Any], model: Model) -> Estimator:
    """Build the estimator `settings['type']` (default: the label) on a model.

    Raises:
        EstimatorError: unknown estimator or setting, or a value out of range.
    """
    arguments = dict(settings)
    name = arguments.pop("type", label)
    if not isinstance(name, str):
        raise EstimatorError(
            f"estimator {name!r} is no name; use one of `estbench list` or package.module:Name"
        )
    cls = resolve(name)
    parameters = inspect.signature(cls).parameters
    accepted = [p for p in parameters if p not in ("model", "self")]
    anything = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
    for setting in arguments:
        if setting not in accepted and not anything:
            raise EstimatorError(
                f"{label}: no setting '{setting}'{did_you_mean(setting, accepted)}"
            )
    try:
        return cls(model, **arguments)
    except EstbenchError:
        raise
    except (Exception, SystemExit) as error:
        raise EstimatorError(
            f"{label}: {name}(model, {arguments}) raised {user_error_location(error)}"
        ) from None
