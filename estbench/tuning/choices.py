"""Choices between values, and conditional ones, by optuna's tree-structured Parzen estimator."""

import numpy as np

from estbench.errors import MissingExtraError
from estbench.tuning.parameters import Parameter
from estbench.tuning.problem import Problem

try:
    import optuna  # pyright: ignore[reportMissingImports]  # an extra
except ImportError:
    raise MissingExtraError("optuna", "tune") from None

TOGETHER = 4
"""Candidates that are asked for together, and computed as one set."""


def search(problem: Problem, seed: int, most: int) -> None:
    """Search; the result is `problem.best`.

    Args:
        problem: what is minimized.
        seed: of the sampler: the same candidates for the same losses.
        most: candidates.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    sampler = optuna.samplers.TPESampler(seed=seed, multivariate=True, n_startup_trials=8)
    study = optuna.create_study(sampler=sampler)
    study.enqueue_trial({p.key: p.coordinate(p.start) for p in problem.parameters})
    while (left := most - len(study.trials)) > 0:
        trials = [study.ask() for _ in range(min(TOGETHER, left))]
        points = np.array([[_suggest(trial, p) for p in problem.parameters] for trial in trials])
        found, losses = problem.at(points)
        for trial, loss, reason, point in zip(trials, losses, found.reasons, points):
            failed = optuna.trial.TrialState.FAIL
            if reason:
                study.tell(trial, state=failed)
            else:
                study.tell(trial, float(loss))
            problem.visited(point, float(loss))


def _suggest(trial: optuna.Trial, parameter: Parameter) -> float:
    """The coordinate of a parameter in a trial."""
    low, high = parameter.bounds
    if parameter.kind == "choice":
        return float(trial.suggest_categorical(parameter.key, range(len(parameter.choices))))
    return trial.suggest_float(parameter.key, low, high)
