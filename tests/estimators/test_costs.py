"""The model evaluations of a step are those that docs/estimators.md promises."""

from dataclasses import replace

import numpy as np
import pytest

from estbench.estimators import registry
from estbench.estimators.protocol import FilterHistory, Measurement
from estbench.models.continuous import ContinuousFunctionModel
from estbench.models.differences import Differences
from tests.helpers import nonlinear_model

N, RUNS, SIZE = 4, 2, 20
"""States, runs, and points of the sampled filters."""


class Counter:
    """A function of states that counts for how many states per run it is asked."""

    def __init__(self, function):
        self.function, self.count = function, 0

    def __call__(self, x, *arguments):
        self.count += x[..., 0].size
        return self.function(x, *arguments)

    def taken(self):
        count, self.count = self.count, 0
        return count / RUNS


def counted():
    """A model without Jacobians, and the counters of its f and h."""
    plain = nonlinear_model(N, jacobians=False)
    f, h = Counter(plain.f), Counter(plain.h)
    return replace(plain, f=f, h=h, differences=Differences("forward", 1e-6)), f, h


def step(estimator, belief, t):
    u, y = np.zeros((RUNS, 1)), np.ones((RUNS, N // 2 + 1))
    return estimator.update(estimator.predict(belief, u, t, 0.1), y, u, t + 0.1)[0]


def prior():
    return np.full((RUNS, N), 0.1), np.tile(0.01 * np.eye(N), (RUNS, 1, 1))


JACOBIAN = (N + 1, N + 1)
SIGMA = (2 * N + 1, 2 * N + 1)


@pytest.mark.parametrize(
    ("name", "settings", "expected"),
    [
        ("kf", {}, (1, 1)),
        ("lkf", {}, JACOBIAN),
        ("ekf", {}, JACOBIAN),
        ("sr_ekf", {}, JACOBIAN),
        ("iekf", {"iterations": 3, "tolerance": 0.0}, (N + 1, 3 * (N + 1))),
        ("ukf", {}, SIGMA),
        ("ukf", {"redraw": False}, SIGMA),
        ("sr_ukf", {}, SIGMA),
        ("ckf", {}, (2 * N, 2 * N)),
        ("ghkf", {"order": 2}, (2**N, 2**N)),
        ("ghkf", {"order": 3}, (3**N, 3**N)),
        ("rotated_ukf", {}, SIGMA),
        ("rotated_ukf", {"rotations": 2, "centre_weight": 0}, (4 * N, 4 * N)),
        ("iplf", {"iterations": 3, "tolerance": 0.0}, (2 * N + 1, 3 * (2 * N + 1))),
        ("diplf", {"base": "ckf", "tolerance": 0.0}, (4 * N, 4 * N)),
        ("diplf", {"measurement_iterations": 2, "tolerance": 0.0}, (4 * N + 2, 8 * N + 4)),
        ("enkf", {"size": SIZE}, (SIZE, SIZE)),
        ("pf", {"size": SIZE, "regularization": 0.5}, (SIZE, SIZE)),
        ("imm", {}, (2 * (N + 1), 2 * (N + 1))),
        ("imm", {"process_noise_scales": [1, 2, 3], "base": "ckf"}, (6 * N, 6 * N)),
        ("robust_ekf", {"method": "huber"}, JACOBIAN),
        ("robust_ekf", {"method": "student_t"}, JACOBIAN),
        ("adaptive_ekf", {"adapt": "both"}, JACOBIAN),
        ("schmidt_ekf", {"considered": ["x0"]}, JACOBIAN),
        ("bias_ekf", {"bias": 0.1}, JACOBIAN),
        ("bias_ekf", {"bias": 0.1, "inputs": 0.1}, (N + 4, N + 4)),
        ("bias_ukf", {"bias": {"y0": 0.1}}, (2 * N + 3, 2 * N + 3)),
        ("converted_ekf", {"range": "y0", "bearing": "y1", "position": ["x0", "x1"]}, JACOBIAN),
        # The adapters ask once more whether every component has a return.
        ("filterpy_ekf", {}, (JACOBIAN[0], JACOBIAN[1] + 1)),
        ("filterpy_ukf", {}, (SIGMA[0], SIGMA[1] + 1)),
        ("stonesoup_ekf", {}, (N + 2, 2 * N + 4)),
        ("stonesoup_ukf", {}, (SIGMA[0], SIGMA[1] + 1)),
    ],
)
def test_a_step(name, settings, expected):
    model, f, h = counted()
    estimator = registry.create(name, settings, model)
    belief = step(estimator, estimator.init(*prior()), 0.0)  # `kf` linearizes in the first one
    f.taken(), h.taken()
    step(estimator, belief, 0.1)
    assert (f.taken(), h.taken()) == expected


@pytest.mark.parametrize("substeps", [1, 3])
def test_a_step_of_the_continuous_discrete_filter(substeps):
    plain = nonlinear_model(N, jacobians=False)
    flow, h = Counter(lambda x, u, t: plain.f(x, u, t, 1.0) - x), Counter(plain.h)
    model = ContinuousFunctionModel(
        flow, h, plain.Q, plain.R, n_controls=1, differences=Differences("forward", 1e-6)
    )
    estimator = registry.create("cd_ekf", {"substeps": substeps}, model)
    step(estimator, estimator.init(*prior()), 0.0)
    assert (flow.taken(), h.taken()) == (4 * substeps * (N + 1), N + 1)


@pytest.mark.parametrize(
    ("name", "settings", "expected"),
    [
        ("rts", {}, (N + 1, 0)),
        ("urts", {}, (2 * N + 1, 0)),
        ("map", {"iterations": 3}, None),
        ("ipls", {"iterations": 3, "tolerance": 0.0}, (3 * (2 * N + 1), 3 * (2 * N + 1))),
    ],
)
def test_looking_back(name, settings, expected):
    model, f, h = counted()
    steps = 5
    estimator = registry.create(name, settings, model)
    beliefs = [estimator.init(*prior())]
    for k in range(steps):
        beliefs.append(step(estimator, beliefs[-1], 0.1 * k))
    f.taken(), h.taken()
    u, y = np.zeros((RUNS, 1)), np.ones((RUNS, N // 2 + 1))
    measured = [[], *([Measurement(y, u)] for _ in range(steps))]
    times = [0.1 * k for k in range(steps + 1)]
    estimator.smooth(FilterHistory(beliefs, [u] * steps, times, measured))
    seen = f.taken() / steps, h.taken() / steps
    if expected is None:
        # At most 3 iterations, and one more linearization for the covariances.
        assert N + 1 < seen[0] == seen[1] <= 4 * (N + 1)
    else:
        assert seen == expected
