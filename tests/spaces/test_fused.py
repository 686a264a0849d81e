from dataclasses import replace

import numpy as np
import pytest

from estbench.estimators import ekf, sigma_points
from estbench.estimators.beliefs import Fault
from estbench.estimators.linear import linear_update
from estbench.estimators.points import points_update
from estbench.estimators.protocol import Gain
from estbench.models.function import FunctionModel
from estbench.spaces import fused, loops
from estbench.spaces.manifold import Manifold

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
        written = [getattr(loops, f"_{name}") for name in loops.Loops._fields]
        monkeypatch.setattr(fused, "compiled", lambda: loops.Loops(*written))


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


@pytest.mark.parametrize(("n", "m"), [(1, 1), (2, 1), (1, 2), (4, 4), (6, 3)])
def test_the_loops_are_numpys_sigma_points(n, m, looped, monkeypatch):
    """Points, moments and update, with a negative weight at the centre."""
    belief, residual, H, R = problem(n, m, np.random.default_rng(n + 10 * m))
    space, rule = Manifold.euclidean(n), sigma_points.scaled(n, alpha=0.7)

    def step():
        points, spread = rule.around(space, belief.mean, belief.cov)
        images = points @ H.mT + np.cos(points[..., :1])
        predicted, deviation, S = rule.moments(Manifold.euclidean(m), images)
        assert (fused.updated_points(spread, deviation, rule.cov_weights, S, R, residual) is None
                ) is (fused.compiled() is None)  # fmt: skip
        update = points_update(rule, residual - predicted, spread, deviation, S, R)
        assert not update.fault.any()
        return points, spread, predicted, deviation, S, update.delta, update.cov, update.innovation

    *got, inn = step()
    monkeypatch.setattr(fused, "compiled", lambda: None)
    *wanted, ref = step()
    for a, b in zip(got, wanted, strict=True):
        close(a, b)
    for name in ("residual", "cov", "white", "nis", "dof", "factor"):
        close(getattr(inn, name), getattr(ref, name))
    assert isinstance(inn.gain, Gain)
    assert isinstance(ref.gain, Gain)
    close(inn.gain.matrix, ref.gain.matrix)


def close(got, wanted):
    np.testing.assert_allclose(got, wanted, rtol=1e-11, atol=1e-12)


def test_numpy_judges_what_the_loop_cannot(looped):
    """In its runs; to the last bit, the others are what they are without them."""
    belief, residual, H, R = problem(2, 1, np.random.default_rng(0))
    rule, space = sigma_points.scaled(2), Manifold.euclidean(2)
    cov, mask, odd = belief.cov.copy(), np.ones((RUNS, 1), bool), [3, 5, 6]
    cov[3], mask[5], residual[6] = -1e3 * np.eye(2), False, -np.inf  # no factor, reading, return
    with np.errstate(invalid="ignore"):
        got, inn = linear_update(space, replace(belief, cov=cov), residual, H, R, mask)
        _, spread = rule.around(space, belief.mean, cov)
    assert got.fault.tolist() == [Fault.INNOVATION if run == 3 else 0 for run in range(RUNS)]
    assert np.flatnonzero(inn.dof == 0).tolist() == [5, 6]
    np.testing.assert_array_equal(got.cov[5:7], cov[5:7])
    np.testing.assert_array_equal(got.mean[5:7], belief.mean[5:7])
    rest = np.delete(np.arange(RUNS), odd)
    alone, _ = linear_update(space, prior(2, cov[rest]), residual[rest], H[rest], R)
    np.testing.assert_array_equal(got.mean[rest], alone.mean)
    np.testing.assert_array_equal(got.cov[rest], alone.cov)
    assert fused.updated(belief.cov, H, np.tile(R, (RUNS, 1, 1)), residual) is None
    np.testing.assert_array_equal(np.isnan(spread).all(axis=(1, 2)), np.arange(RUNS) == 3)
    cov[3] = [[4.0, 2.0], [2.0, 1.0]]  # semidefinite
    with np.errstate(invalid="ignore"):
        _, spread = rule.around(space, belief.mean, cov)
    close(rule.cross(spread, spread), cov)
