import numpy as np
import pytest

from estbench.estimators import ekf
from estbench.estimators.linear import linear_update
from estbench.estimators.protocol import Gain
from estbench.models.function import FunctionModel
from estbench.spaces import fused

RUNS = 20


def problem(n, m, rng):
    """A prior of each run, a residual, H and R."""
    root = rng.standard_normal((RUNS, n, n))
    belief = prior(n, root @ root.mT + 0.1 * np.eye(n))
    noise = rng.standard_normal((m, m))
    R = noise @ noise.T + 0.1 * np.eye(m)
    return belief, rng.standard_normal((RUNS, m)), rng.standard_normal((RUNS, m, n)), R


def prior(n, cov):
    model = FunctionModel(lambda x, *_: x, lambda x, *_: x[..., :1], np.eye(n), np.eye(1))
    estimator = ekf.EKF(model)
    return estimator.init(np.zeros((len(cov), n)), cov)


@pytest.fixture
def looped(monkeypatch):
    """The loop, by the interpreter where numba is not installed."""
    if not fused.compiled():
        monkeypatch.setattr(fused, "compiled", lambda: fused.Loops(fused._predict, fused._update))


@pytest.mark.parametrize(("n", "m"), [(1, 1), (2, 1), (1, 2), (4, 4), (6, 3)])
def test_the_loop_is_numpys_update(n, m, looped, monkeypatch):
    belief, residual, H, R = problem(n, m, np.random.default_rng(n + 10 * m))
    space = FunctionModel(lambda x, *_: x, lambda x, *_: x[..., :1], np.eye(n), np.eye(1)).space
    assert fused.updated(belief.cov, H, R, residual) is not None
    got, inn = linear_update(space, belief, residual, H, R)
    monkeypatch.setattr(fused, "compiled", lambda: None)
    assert fused.updated(belief.cov, H, R, residual) is None
    wanted, ref = linear_update(space, belief, residual, H, R)
    for name in ("mean", "cov", "fault"):
        close(getattr(got, name), getattr(wanted, name))
    for name in ("residual", "cov", "white", "nis", "dof", "factor"):
        close(getattr(inn, name), getattr(ref, name))
    assert isinstance(inn.gain, Gain)
    assert isinstance(ref.gain, Gain)
    close(inn.gain.matrix, ref.gain.matrix)


def test_the_loop_is_numpys_prediction(looped):
    rng = np.random.default_rng(3)
    F, root = rng.standard_normal((2, RUNS, 4, 4))
    P, Q = root @ root.mT, np.diag([1.0, 2.0, 3.0, 0.0])
    close(fused.predicted(F, P, Q), F @ P @ F.mT + Q)
    assert fused.predicted(F, P, np.tile(Q, (RUNS, 1, 1))) is None
    large = np.tile(np.eye(7), (RUNS, 1, 1))
    assert fused.predicted(large, large, np.eye(7)) is None


def close(got, wanted):
    np.testing.assert_allclose(got, wanted, rtol=1e-11, atol=1e-12)


def test_numpy_judges_what_the_loop_cannot(looped):
    belief, residual, H, R = problem(2, 1, np.random.default_rng(0))
    cov = belief.cov.copy()
    cov[3] = -1e3 * np.eye(2)  # S has no factor
    with np.errstate(invalid="ignore"):
        assert fused.updated(cov, H, R, residual) is None
    assert fused.updated(belief.cov, H, np.tile(R, (RUNS, 1, 1)), residual) is None
