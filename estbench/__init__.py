"""estbench: a testbed for state estimators on simulated robots.

>>> import estbench
>>> results = estbench.run("pendulum", ["ekf"], runs=100, duration=1.0)
>>> str(results["ekf"].verdict)
'consistent'

Every public name is imported when it is first used. So the command line starts before MuJoCo is
imported, and can report an error of that import.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from estbench.bounds.expectation import Bound, Reading, posterior_bound
    from estbench.budgets.budget import budget
    from estbench.errors import (
        ControllerError,
        CovarianceError,
        DimensionError,
        EstbenchError,
        EstimatorError,
        MissingExtraError,
        ModelError,
        ScenarioError,
        StoreError,
        StudyError,
    )
    from estbench.estimators.beliefs import Gaussian
    from estbench.estimators.ckf import CKF
    from estbench.estimators.ekf import EKF
    from estbench.estimators.enkf import EnKF
    from estbench.estimators.iekf import IEKF
    from estbench.estimators.imm import IMM
    from estbench.estimators.kf import KF
    from estbench.estimators.particle import ParticleFilter
    from estbench.estimators.protocol import Estimator, FilterHistory, Innovation, Smoother
    from estbench.estimators.ukf import UKF
    from estbench.following import follow
    from estbench.logs.replay import replay
    from estbench.models.continuous import ContinuousFunctionModel
    from estbench.models.function import FunctionModel
    from estbench.models.linear import LinearModel
    from estbench.models.protocol import Model
    from estbench.montecarlo.results import Results
    from estbench.montecarlo.run import run
    from estbench.robots.model import MujocoModel
    from estbench.scenario.load import load
    from estbench.scenario.schema import Scenario
    from estbench.sensitivities.sensitivity import sensitivity
    from estbench.smoothers.estimators import MAP, RTS, URTS
    from estbench.store.reader import open_results
    from estbench.study.store import open_study
    from estbench.study.sweep import sweep
    from estbench.suites.design import design
    from estbench.suites.observability import observability
    from estbench.tuning.tune import tune

__version__ = "0.1.0"
__all__ = [
    "CKF",
    "EKF",
    "IEKF",
    "IMM",
    "KF",
    "MAP",
    "RTS",
    "UKF",
    "URTS",
    "Bound",
    "ContinuousFunctionModel",
    "ControllerError",
    "CovarianceError",
    "DimensionError",
    "EnKF",
    "EstbenchError",
    "Estimator",
    "EstimatorError",
    "FilterHistory",
    "FunctionModel",
    "Gaussian",
    "Innovation",
    "LinearModel",
    "MissingExtraError",
    "Model",
    "ModelError",
    "MujocoModel",
    "ParticleFilter",
    "Reading",
    "Results",
    "Scenario",
    "ScenarioError",
    "Smoother",
    "StoreError",
    "StudyError",
    "budget",
    "design",
    "follow",
    "load",
    "observability",
    "open_results",
    "open_study",
    "posterior_bound",
    "replay",
    "run",
    "sensitivity",
    "sweep",
    "tune",
]

_MODULES = {
    "budgets.budget": ("budget",),
    "bounds.expectation": ("Bound", "Reading", "posterior_bound"),
    "errors": (
        "ControllerError", "CovarianceError", "DimensionError", "EstbenchError", "EstimatorError",
        "MissingExtraError", "ModelError", "ScenarioError", "StoreError",
        "StudyError",
    ),
    "estimators.beliefs": ("Gaussian",),
    "estimators.ckf": ("CKF",),
    "estimators.ekf": ("EKF",),
    "estimators.enkf": ("EnKF",),
    "estimators.iekf": ("IEKF",),
    "estimators.imm": ("IMM",),
    "estimators.kf": ("KF",),
    "estimators.particle": ("ParticleFilter",),
    "estimators.protocol": ("Estimator", "FilterHistory", "Innovation", "Smoother"),
    "estimators.ukf": ("UKF",),
    "following": ("follow",),
    "logs.replay": ("replay",),
    "models.continuous": ("ContinuousFunctionModel",),
    "models.function": ("FunctionModel",),
    "models.linear": ("LinearModel",),
    "models.protocol": ("Model",),
    "montecarlo.results": ("Results",),
    "montecarlo.run": ("run",),
    "robots.model": ("MujocoModel",),
    "scenario.load": ("load",),
    "scenario.schema": ("Scenario",),
    "sensitivities.sensitivity": ("sensitivity",),
    "smoothers.estimators": ("MAP", "RTS", "URTS"),
    "store.reader": ("open_results",),
    "study.store": ("open_study",),
    "study.sweep": ("sweep",),
    "suites.design": ("design",),
    "suites.observability": ("observability",),
    "tuning.tune": ("tune",),
}  # fmt: skip
_HOME = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import a public name from its module."""
    if name not in _HOME:
        raise AttributeError(f"module 'estbench' has no attribute '{name}'")
    return getattr(import_module(f"estbench.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
