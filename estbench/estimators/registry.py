"""Estimators by name: the built-in ones, those of installed packages, and `package.module:Name`."""

import inspect
import sys
from collections.abc import Mapping
from importlib.metadata import entry_points
from typing import Any

from estbench.errors import EstbenchError, EstimatorError, did_you_mean, user_error_location
from estbench.estimators.protocol import Estimator
from estbench.models.protocol import Model
from estbench.plugins import load_module

_BUILTIN = {
    "kf": "kf:KF",
    "lkf": "lkf:LKF",
    "ekf": "ekf:EKF",
    "sr_ekf": "sr_ekf:SquareRootEKF",
    "iekf": "iekf:IEKF",
    "cd_ekf": "cd_ekf:ContinuousDiscreteEKF",
    "ukf": "ukf:UKF",
    "sr_ukf": "sr_ukf:SquareRootUKF",
    "ckf": "ckf:CKF",
    "ghkf": "ghkf:GHKF",
    "rotated_ukf": "rotated_ukf:RotatedUKF",
    "iplf": "iplf:IPLF",
    "diplf": "diplf:DIPLF",
    "enkf": "enkf:EnKF",
    "pf": "particle:ParticleFilter",
    "imm": "imm:IMM",
    "robust_ekf": "robust:RobustEKF",
    "adaptive_ekf": "adaptive:AdaptiveEKF",
    "schmidt_ekf": "schmidt:SchmidtEKF",
    "bias_ekf": "biased:BiasEKF",
    "bias_ukf": "biased:BiasUKF",
    "converted_ekf": "converted:ConvertedEKF",
    "contact_ekf": "contact_ekf:ContactEKF",
    "contact_inekf": "contact_inekf:ContactInEKF",
    "gtsam_inekf": "adapters.gtsam:GtsamInEKF",
    "filterpy_ekf": "adapters.filterpy:FilterPyEKF",
    "filterpy_ukf": "adapters.filterpy:FilterPyUKF",
    "stonesoup_ekf": "adapters.stonesoup:StoneSoupEKF",
    "stonesoup_ukf": "adapters.stonesoup:StoneSoupUKF",
}
_SMOOTHERS = {"rts": "RTS", "urts": "URTS", "ipls": "IPLS", "map": "MAP"}
BUILTIN = {name: f"estbench.estimators.{target}" for name, target in _BUILTIN.items()}
BUILTIN |= {name: f"estbench.smoothers.estimators:{target}" for name, target in _SMOOTHERS.items()}
GROUP = "estbench.estimators"
METHODS = ("init", "predict", "update", "mean", "cov")


def known() -> dict[str, str]:
    """Name -> `module:Class` of the built-in estimators, then of the entry points."""
    return {point.name: point.value for point in entry_points(group=GROUP)} | BUILTIN


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


def name_of(estimator: str | type) -> str:
    """The name itself, or `module:Name` of a class, by which workers import it.

    Raises:
        EstimatorError: it is neither, or the class cannot be imported by that name.
    """
    if isinstance(estimator, str):
        return estimator
    if not isinstance(estimator, type):
        raise EstimatorError(
            f"estimator {estimator!r} is neither a name nor a class; use one of `estbench list`, "
            "package.module:Name, or a class"
        )
    module, name = estimator.__module__, estimator.__qualname__
    if getattr(sys.modules.get(module), name, None) is not estimator:
        raise EstimatorError(
            f"estimator {name}: the class cannot be imported as {module}:{name}; define it at the "
            "top of a module"
        )
    return f"{module}:{name}"


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
