"""Calibration of the interval of NEES/n, by itself, on models where the filter is exact.

On a linear-Gaussian model the Kalman filter's covariance is exact. Each interval without 1 is then
a false alarm, and a filter with a wrong Q is wrong by a known factor. The truth is simulated with
numpy alone, not with the code under test. `trials` does the same for the whole verdict.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import expm

from estbench.analysis.trials import STEP
from estbench.consistency.intervals import Interval, positive_mean_interval, wilson
from estbench.estimators.kf import KF
from estbench.estimators.protocol import Estimator
from estbench.models.linear import LinearModel
from estbench.shapes import Array
from estbench.spaces.linalg import quadratic_form
from estbench.spaces.semidefinite import eigen_root

ROWS = 20_000
"""Runs simulated at once."""


def oscillator(dt: float = STEP) -> LinearModel:
    """A damped oscillator of 1 Hz, driven by a white force; its position is measured."""
    w, zeta = 2 * np.pi, 0.1
    A = np.asarray(expm(np.array([[0.0, 1.0], [-(w**2), -2 * zeta * w]]) * dt), np.float64)
    return LinearModel(A, np.array([[1.0, 0.0]]), np.diag([1e-4, 0.1]), np.array([[0.01]]))


def vehicle(dt: float = STEP) -> LinearModel:
    """Nearly constant velocity in the plane, positions measured (Bar-Shalom et al. 2001, 6.3.2)."""
    block: Array = np.array([[1.0, dt], [0.0, 1.0]])
    noise: Array = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    A, C, Q = (_twice(a) for a in (block, np.array([[1.0, 0.0]]), noise))
    return LinearModel(A, C, Q, 0.25 * np.eye(2))


def observed(dt: float = STEP) -> LinearModel:
    """The oscillator with a sensor on each coordinate, so that an infinite Q makes P their R."""
    plain = oscillator(dt)
    return LinearModel(plain.A, np.eye(2), plain.Q, np.diag([0.01, 0.1]))


def _twice(a: Array) -> Array:
    """The block-diagonal matrix of two independent axes."""
    return np.asarray(np.kron(np.eye(2), a), np.float64)


def averages(
    truth: LinearModel,
    runs: int,
    steps: int,
    seed: int,
    *,
    process_noise_scale: float = 1.0,
    estimator: Callable[[LinearModel], Estimator] = KF,
    spread: float = 1.0,
) -> Array:
    """NEES/n of each run, averaged over its steps `(run,)`.

    Args:
        truth: x⁺ = A x + w, y = C x + v.
        runs: count of runs.
        steps: of each run; the prior is left out of the average.
        seed: of all random numbers.
        process_noise_scale: the filter's Q over the true one.
        estimator: a class of `estbench.estimators`.
        spread: standard deviation of each coordinate at the start, known to the filter.
    """
    n, m = truth.A.shape[-1], truth.C.shape[0]
    filter_ = estimator(replace(truth, Q=process_noise_scale * truth.Q))
    rng = np.random.default_rng(seed)
    noise, sensor = eigen_root(truth.Q)[0], np.linalg.cholesky(truth.R)
    x = spread * rng.standard_normal((runs, n))
    belief = filter_.init(np.zeros((runs, n)), np.tile(spread**2 * np.eye(n), (runs, 1, 1)))
    u, total = np.zeros((runs, 0)), np.zeros(runs)
    for k in range(steps):
        x = x @ truth.A.T + rng.standard_normal((runs, n)) @ noise.T
        y = x @ truth.C.T + rng.standard_normal((runs, m)) @ sensor.T
        belief = filter_.predict(belief, u, float(k), 1.0)
        belief, _ = filter_.update(belief, y, u, float(k + 1))
        total += quadratic_form(filter_.cov(belief), x - filter_.mean(belief))
    return total / (steps * n)


@dataclass(frozen=True)
class Calibration:
    """How often the interval of NEES/n of experiments of one size lies beside 1.

    Attributes:
        runs: per experiment.
        experiments: count of experiments.
        refused: share of the experiments with an interval beside 1, with Wilson's interval.
        above, below: share of those above and below.
    """

    runs: int
    experiments: int
    refused: Interval
    above: float
    below: float


def calibrate(
    values: Array,
    runs: int,
    level: float = 0.95,
    interval: Callable[[Array, float], Interval] = positive_mean_interval,
) -> Calibration:
    """Split runs into experiments, and take the interval of each as `estbench run` does.

    Args:
        values: NEES/n of many runs `(run,)`.
        runs: per experiment; a remainder is not used.
        level: of the interval.
        interval: of the mean, to compare another one.
    """
    count = len(values) // runs
    found = [interval(part, level) for part in values[: count * runs].reshape(count, runs)]
    above, below = sum(i.low > 1 for i in found), sum(i.high < 1 for i in found)
    return Calibration(runs, count, wilson(above + below, count), above / count, below / count)


def sample(
    truth: LinearModel, total: int, steps: int, seed: int, process_noise_scale: float = 1.0
) -> Array:
    """`averages` of many runs, in parts that fit the caches."""
    return np.concatenate(
        [
            averages(
                truth, min(ROWS, total - start), steps, seed + i,
                process_noise_scale=process_noise_scale,
            )
            for i, start in enumerate(range(0, total, ROWS))
        ]
    )  # fmt: skip
