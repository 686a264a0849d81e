import numpy as np
import pytest

from estbench.errors import DimensionError
from estbench.estimators.beliefs import Fault
from estbench.estimators.ekf import EKF
from estbench.estimators.ukf import UKF
from estbench.models.linear import LinearModel
from estbench.smoothers.rts import rts
from estbench.smoothers.urts import urts
from tests.estimators.test_enkf import start
from tests.helpers import linear_model, mujoco_model, nonlinear_model, random_states

SMOOTHERS = [(EKF, rts), (UKF, urts)]


def filtered(model, filter, mean, cov, controls, ys, dt, masks=None):
    """Posteriors at 0, dt, ...; y[k] is measured under the control that led to it."""
    times = [k * dt for k in range(len(ys))]
    belief = filter.init(mean, cov)
    out = []
    for k, y in enumerate(ys):
        if k:
            belief = filter.predict(belief, controls[k - 1], times[k - 1], dt)
        mask = None if masks is None else masks[k]
        belief, _ = filter.update(belief, y, controls[max(k - 1, 0)], times[k], mask=mask)
        out.append(belief)
    return out, times


def batch(model: LinearModel, mean, cov, controls, ys, masks=None):
    """Mean `(K + 1, n)` and covariances of one run by conditioning the joint Gaussian of all."""
    assert model.B is not None
    assert model.D is not None
    n, count = model.space.n, len(ys)
    mus, L = [mean], np.zeros((count * n, count * n))
    blocks = [cov] + [model.Q] * (count - 1)
    for k in range(count):
        L[k * n : (k + 1) * n, k * n : (k + 1) * n] = np.eye(n)
        if k:
            mus.append(model.A @ mus[-1] + model.B @ controls[k - 1])
            above = L[(k - 1) * n : k * n]
            L[k * n : (k + 1) * n, : k * n] = (model.A @ above)[:, : k * n]
    noise = np.zeros_like(L)
    for k, block in enumerate(blocks):
        noise[k * n : (k + 1) * n, k * n : (k + 1) * n] = block
    mu, P = np.concatenate(mus), L @ noise @ L.T
    rows, values, R = [], [], []
    for k, y in enumerate(ys):
        for j in range(len(y)):
            if masks is None or masks[k][j]:
                row = np.zeros(count * n)
                row[k * n : (k + 1) * n] = model.C[j]
                rows.append(row)
                values.append(y[j] - model.D[j] @ controls[max(k - 1, 0)])
                R.append((k, j))
    H = np.array(rows)
    full = np.array([[model.R[i, j] if a == b else 0.0 for b, j in R] for a, i in R])
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + full)
    mu, P = mu + K @ (np.array(values) - H @ mu), P - K @ H @ P
    return mu.reshape(count, n), [P[k * n : (k + 1) * n, k * n : (k + 1) * n] for k in range(count)]


def linear_problem(seed, runs=3, count=8):
    model = linear_model(seed)
    mean, cov, _ = start(model, runs, seed)
    rng = np.random.default_rng(seed)
    controls = list(rng.standard_normal((count - 1, runs, 1)))
    ys = rng.standard_normal((count, runs, 2)) * 2
    masks = rng.uniform(size=(count, runs, 2)) < 0.7
    return model, mean, cov, controls, ys, masks


@pytest.mark.parametrize(("filter", "smoother"), SMOOTHERS)
@pytest.mark.parametrize("seed", range(3))
def test_equals_the_batch_solution_on_a_linear_model(filter, smoother, seed):
    model, mean, cov, controls, ys, masks = linear_problem(seed)
    seen = [np.where(m, y, np.nan) for m, y in zip(masks, ys)]
    posteriors, times = filtered(model, filter(model), mean, cov, controls, seen, 1.0, masks)
    smoothed = smoother(model, posteriors, controls, times)
    for i in range(3):
        inputs, data = [u[i] for u in controls], ys[:, i]
        means, covs = batch(model, mean[i], cov[i], inputs, data, masks[:, i])
        for k, belief in enumerate(smoothed):
            np.testing.assert_allclose(belief.mean[i], means[k], rtol=1e-10, atol=1e-10)
            np.testing.assert_allclose(belief.cov[i], covs[k], rtol=1e-10, atol=1e-10)


def test_extended_equals_the_textbook():
    model, dt = nonlinear_model(4), 0.1
    mean, cov, u = start(model, 2)
    ys = [model.measurement(mean, u, 0.0) + 0.1 * k for k in range(5)]
    posteriors, times = filtered(model, EKF(model), mean, cov, [u] * 4, ys, dt)
    smoothed = rts(model, posteriors, [u] * 4, times)
    for i in range(2):
        m, P = posteriors[-1].mean[i], posteriors[-1].cov[i]
        for k in reversed(range(4)):
            x, Px = posteriors[k].mean[i], posteriors[k].cov[i]
            f, F = (a[0] for a in model.transition_jacobian(x[None], u[i : i + 1], 0.0, dt))
            prior = F @ Px @ F.T + model.Q
            G = Px @ F.T @ np.linalg.inv(prior)
            m, P = x + G @ (m - f), Px + G @ (P - prior) @ G.T
            np.testing.assert_allclose(smoothed[k].mean[i], m, rtol=1e-10, atol=1e-10)
            np.testing.assert_allclose(smoothed[k].cov[i], P, rtol=1e-10, atol=1e-10)


def test_unscented_equals_the_textbook():
    model, dt, n = nonlinear_model(4), 0.1, 4
    mean, cov, u = start(model, 2)
    ys = [model.measurement(mean, u, 0.0) + 0.1 * k for k in range(5)]
    posteriors, times = filtered(model, UKF(model), mean, cov, [u] * 4, ys, dt)
    smoothed = urts(model, posteriors, [u] * 4, times)
    for i in range(2):
        m, P = posteriors[-1].mean[i], posteriors[-1].cov[i]
        for k in reversed(range(4)):
            x, Px = posteriors[k].mean[i], posteriors[k].cov[i]
            columns = np.sqrt(n) * np.linalg.cholesky(Px).T
            points = np.concatenate([x + columns, x - columns])
            images = model.transition(points[None], u[i : i + 1], 0.0, dt)[0]
            centre = model.transition(x[None], u[i : i + 1], 0.0, dt)[0]
            f = images.mean(0)  # α = 1, κ = 0: the centre has no weight in the mean, β = 2 in P
            prior = model.Q + np.cov(images.T, bias=True) + 2 * np.outer(centre - f, centre - f)
            G = (points - x).T @ (images - f) / (2 * n) @ np.linalg.inv(prior)
            m, P = x + G @ (m - f), Px + G @ (P - prior) @ G.T
            np.testing.assert_allclose(smoothed[k].mean[i], m, rtol=1e-10, atol=1e-10)
            np.testing.assert_allclose(smoothed[k].cov[i], P, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(("filter", "smoother"), SMOOTHERS)
def test_a_failed_run_stands_alone(filter, smoother):
    model, mean, cov, controls, ys, _ = linear_problem(1)
    ys[5, 1] = np.nan  # the filter of run 1 fails at time 5
    posteriors, times = filtered(model, filter(model), mean, cov, controls, ys, 1.0)
    smoothed = smoother(model, posteriors, controls, times)
    for belief in smoothed:
        np.testing.assert_array_equal(belief.fault, [0, Fault.STATE, 0])
        assert np.isnan(belief.mean[1]).all()
        assert np.isnan(belief.cov[1]).all()
        assert np.isfinite(belief.cov[[0, 2]]).all()


@pytest.mark.parametrize(("filter", "smoother"), SMOOTHERS)
def test_smoothing_a_robot_with_quaternions_beats_filtering(filter, smoother):
    model = mujoco_model("joints", density=0.05)
    x, u = random_states(model.mjmodel, 12)
    n, dt, rng = model.space.n, 0.02, np.random.default_rng(0)
    output = model.output()
    cov = np.broadcast_to(0.1 * np.eye(n), (12, n, n))
    truth, ys = [x], []
    for k in range(12):
        if k:
            x = model.transition(x, u, 0.0, dt)
            x = model.space.plus(x, np.sqrt(0.05 * dt) * rng.standard_normal((12, n)))
            truth.append(x)
        y = model.measurement(x, u, 0.0)
        ys.append(output.plus(y, 0.1 * rng.standard_normal((12, output.n))))
    mean = model.space.plus(truth[0], np.sqrt(0.1) * rng.standard_normal((12, n)))
    posteriors, times = filtered(model, filter(model), mean, cov, [u] * 11, ys, dt)
    smoothed = smoother(model, posteriors, [u] * 11, times)

    def scores(beliefs):
        rms, nees = 0.0, 0.0
        for belief, x in zip(beliefs, truth):
            error = model.space.minus(x, belief.mean)
            rms += (error**2).mean()
            nees += np.einsum("ri,rij,rj->r", error, np.linalg.inv(belief.cov), error).mean() / n
        return rms / 12, nees / 12

    assert scores(smoothed)[0] < 0.9 * scores(posteriors)[0]
    assert abs(scores(smoothed)[1] - 1) < 0.25


def test_lists_that_do_not_fit_say_so():
    model, mean, cov, controls, ys, _ = linear_problem(1)
    posteriors, times = filtered(model, EKF(model), mean, cov, controls, ys, 1.0)
    for smoother in (rts, urts):
        with pytest.raises(DimensionError, match="8 beliefs, 6 controls and 8 times"):
            smoother(model, posteriors, controls[1:], times)
