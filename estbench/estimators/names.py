"""The names of estimators: the built-in ones, those of installed packages, those of classes.

No module of an estimator is imported: `estbench list` and the check of a scenario need the names
alone.
"""

import sys
from importlib.metadata import entry_points

from estbench.errors import EstimatorError

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


def known() -> dict[str, str]:
    """Name -> `module:Class` of the built-in estimators, then of the entry points."""
    return {point.name: point.value for point in entry_points(group=GROUP)} | BUILTIN


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
