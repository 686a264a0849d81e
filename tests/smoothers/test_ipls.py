import numpy as np
import pytest

from estbench.errors import DimensionError
from estbench.estimators.beliefs import Fault
from estbench.estimators.protocol import Measurement
from estbench.estimators.ukf import UKF
from estbench.smoothers.ipls import ipls
from estbench.smoothers.map import map_estimate
from tests import pendulum
from tests.estimators.test_enkf import start
from tests.helpers import mujoco_model, nonlinear_model, random_cov, random_states

DT = 0.1


def filtered(model, mean, cov, us, ys):
    filter = UKF(model)
    beliefs = [filter.init(mean, cov)]
    for k, (u, y) in enumerate(zip(us, ys)):
        ahead = filter.predict(beliefs[-1], u, k * DT, DT)
        beliefs.append(filter.update(ahead, y, u, (k + 1) * DT)[0])
    seen = [[], *([Measurement(y, u)] for u, y in zip(us, ys))]
    return filter, beliefs, [DT * k for k in range(len(us) + 1)], seen


def regression(function, x, P, unit, weights):
    """Slope, offset and residual covariance of one function, with loops."""
    points = [x + np.linalg.cholesky(P) @ xi for xi in unit]
    images = [function(p) for p in points]
    mean = sum(w * z for w, z in zip(weights[0], images))
    cross = sum(w * np.outer(p - x, z - mean) for w, p, z in zip(weights[1], points, images))
    spread = sum(w * np.outer(z - mean, z - mean) for w, z in zip(weights[1], images))
    A = cross.T @ np.linalg.inv(P)
    return A, mean - A @ x, spread - A @ P @ A.T


def textbook(model, means, covs, us, ys, rule, iterations):
    """One run after Särkkä & Svensson (2023), ch. 14."""
    m0, P0, count = means[0], covs[0], len(us)
    weights = rule.mean_weights, rule.cov_weights
    Q, R = model.process_noise(means[:1], None, 0.0, DT), model.measurement_noise(0.0)
    for _ in range(iterations):
        f = [
            regression(lambda x, u=u: model.transition(x[None], u[None], 0.0, DT)[0], m, P,
                       rule.points, weights)
            for u, m, P in zip(us, means, covs)
        ]  # fmt: skip
        h = [
            regression(lambda x, u=u: model.measurement(x[None], u[None], 0.0)[0], m, P,
                       rule.points, weights)
            for u, m, P in zip(us, means[1:], covs[1:])
        ]  # fmt: skip
        x, P, xs, Ps, ahead = m0, P0, [m0], [P0], []
        for (A, a, W), (H, b, V), y in zip(f, h, ys):
            x, P = A @ x + a, A @ P @ A.T + W + Q
            ahead.append((x, P))
            S = H @ P @ H.T + V + R
            K = P @ H.T @ np.linalg.inv(S)
            x, P = x + K @ (y - H @ x - b), P - K @ S @ K.T
            xs.append(x)
            Ps.append(P)
        for k in reversed(range(count)):
            G = Ps[k] @ f[k][0].T @ np.linalg.inv(ahead[k][1])
            xs[k] = xs[k] + G @ (xs[k + 1] - ahead[k][0])
            Ps[k] = Ps[k] + G @ (Ps[k + 1] - ahead[k][1]) @ G.T
        means, covs = xs, Ps
    return means, covs


@pytest.mark.parametrize("n", [2, 4])
@pytest.mark.parametrize("iterations", [1, 3])
def test_equals_the_textbook(n, iterations):
    model = nonlinear_model(n)
    mean, cov, _ = start(model, 3)
    rng = np.random.default_rng(n)
    us, ys = list(rng.standard_normal((5, 3, 1))), list(rng.standard_normal((5, 3, n // 2 + 1)))
    filter, beliefs, times, seen = filtered(model, mean, cov, us, ys)
    found = ipls(
        model, beliefs, us, times, seen, lambda k, purpose: filter.rule,
        iterations=iterations, tolerance=0.0,
    )  # fmt: skip
    for i in range(3):
        means, covs = textbook(
            model, [b.mean[i] for b in beliefs], [b.cov[i] for b in beliefs],
            [u[i] for u in us], [y[i] for y in ys], filter.rule, iterations,
        )  # fmt: skip
        for ours, x, P in zip(found, means, covs):
            np.testing.assert_allclose(ours.mean[i], x, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(ours.cov[i], P, rtol=1e-9, atol=1e-9)


def test_the_printed_error_of_the_pendulum():
    """Särkkä & Svensson (2023), example 14.23: IPLS RMSE 0.03473 (third-order Gauss-Hermite)."""
    assert pendulum.rmse("ipls", {"settings": {"base": "ghkf"}}) == pytest.approx(0.03473, abs=1e-5)


def test_ball_and_free_joints_come_to_the_mode_where_little_is_unknown():
    """With small covariances the regression is the derivative, and the fixed point the MAP."""
    model = mujoco_model("joints", "additive", 1e-4)
    x, u = random_states(model.mjmodel, 2, seed=1)
    space = model.space
    cov = 1e-4 * random_cov(np.random.default_rng(1), space.n, 2)
    us = [u] * 4
    truth, ys = space.plus(x, 0.01 * np.ones(space.n)), []
    for _ in us:
        truth = model.transition(truth, u, 0.0, DT)
        ys.append(model.measurement(truth, u, 0.0))
    filter, beliefs, times, seen = filtered(model, x, cov, us, ys)
    found = ipls(model, beliefs, us, times, seen, lambda k, purpose: filter.rule, tolerance=1e-6)
    mode = map_estimate(model, beliefs[0], us, times, seen).beliefs
    for ours, theirs, filter_ in zip(found, mode, beliefs):
        std = np.sqrt(np.diagonal(theirs.cov, axis1=-2, axis2=-1))
        assert np.abs(space.minus(ours.mean, theirs.mean) / std).max() < 0.05
        np.testing.assert_allclose(
            np.sqrt(np.diagonal(ours.cov, axis1=-2, axis2=-1)), std, rtol=0.05
        )
        assert not filter_.fault.any()


def test_a_failed_run_leaves_the_others_alone():
    model = nonlinear_model(4)
    mean, cov, _ = start(model, 3)
    rng = np.random.default_rng(0)
    us, ys = list(rng.standard_normal((4, 3, 1))), list(rng.standard_normal((4, 3, 3)))
    ys[2][1] = np.nan
    with np.errstate(invalid="ignore"):
        filter, beliefs, times, seen = filtered(model, mean, cov, us, ys)
        found = ipls(model, beliefs, us, times, seen, lambda k, purpose: filter.rule)
    good = [0, 2]
    us, ys = [u[good] for u in us], [y[good] for y in ys]
    _, few, _, part = filtered(model, mean[good], cov[good], us, ys)
    alone = ipls(model, few, us, times, part, lambda k, purpose: filter.rule)
    for ours, theirs in zip(found, alone):
        np.testing.assert_array_equal(ours.fault, [0, Fault.STATE, 0])
        np.testing.assert_allclose(ours.mean[good], theirs.mean, atol=1e-12)


def test_a_coordinate_that_is_known_exactly_stays_so():
    model = nonlinear_model(2)
    frozen = type(model)(lambda x, u, t, dt: x, model.h, np.diag([0.1, 0.0]), model.R, n_controls=1)
    mean, cov = np.zeros((2, 2)), np.tile(np.diag([0.1, 0.0]), (2, 1, 1))
    us, ys = [np.zeros((2, 1))] * 3, [np.full((2, 2), 1.9)] * 3
    filter, beliefs, times, seen = filtered(frozen, mean, cov, us, ys)
    found = ipls(frozen, beliefs, us, times, seen, lambda k, purpose: filter.rule)
    for belief in found:
        assert not belief.fault.any()
        np.testing.assert_allclose(belief.mean[:, 1], 0.0, atol=1e-12)


def test_lengths_that_do_not_fit():
    model = nonlinear_model(2)
    with pytest.raises(DimensionError, match="do not fit"):
        ipls(model, [], [], [0.0], [], lambda k, purpose: UKF(model).rule)
