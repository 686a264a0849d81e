"""The bound of models: against Riccati's recursion, the definition, other recursions, a grid."""

from dataclasses import replace

import numpy as np
import pytest

from estbench.bounds.expectation import Reading, posterior_bound
from estbench.errors import DimensionError
from estbench.models.function import FunctionModel
from estbench.models.linear import LinearModel
from estbench.robots import layout
from tests.helpers import (
    CENTERED,
    ChannelModel,
    linear_model,
    mujoco_model,
    random_cov,
    random_states,
)

RUNS, STEPS = 5, 30
TIMES = np.arange(STEPS + 1.0)


class Periodic:
    """A linear model whose matrices alternate between those of several models."""

    def __init__(self, *models: LinearModel):
        self._models, self.space, self.nu = models, models[0].space, models[0].nu
        self.output = models[0].output

    def at(self, t: float) -> LinearModel:
        return self._models[round(t) % len(self._models)]

    def transition_jacobian(self, x, u, t, dt):
        return self.at(t).transition_jacobian(x, u, t, dt)

    def process_noise(self, x, u, t, dt):
        return self.at(t).Q

    def measurement_jacobian(self, x, u, t, channels=None):
        return self.at(t).measurement_jacobian(x, u, t)

    def measurement_noise(self, t, channels=None):
        return self.at(t).R


def states(space_n: int, runs: int = RUNS, steps: int = STEPS):
    return np.random.default_rng(0).standard_normal((steps + 1, runs, space_n))


def riccati(model, P, reads=lambda k: True):
    """The Kalman filter's covariances, from the textbook."""
    out = [P]
    for k in range(1, STEPS + 1):
        before, now = (
            (model.at(k - 1), model.at(k)) if isinstance(model, Periodic) else (model,) * 2
        )
        P = before.A @ P @ before.A.T + before.Q
        if reads(k):
            S = now.C @ P @ now.C.T + now.R
            P = P - P @ now.C.T @ np.linalg.solve(S, now.C @ P)
        out.append(P)
    return np.array(out)


@pytest.mark.parametrize("seed", range(3))
def test_it_is_riccatis_recursion_on_a_linear_model_with_singular_q(seed):
    model = linear_model(seed, 4, 2)
    assert np.linalg.matrix_rank(model.Q) == 3
    P0 = random_cov(np.random.default_rng(seed), 4)
    P0[0] = P0[:, 0] = 0.0  # the first coordinate is known at the start
    u = np.zeros((STEPS, RUNS, 1))
    found = posterior_bound(model, np.zeros(4), P0, TIMES, states(4), u)
    expected = riccati(model, P0)
    np.testing.assert_allclose(found.cov, expected, rtol=1e-9, atol=1e-12)
    diagonal = np.diagonal(expected, axis1=1, axis2=2)
    np.testing.assert_allclose(found.values.mean(axis=1), diagonal, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(np.ptp(found.values, axis=1), 0.0, atol=1e-12)


def test_it_is_riccatis_recursion_with_regular_q_varying_in_time_and_at_several_rates():
    rng = np.random.default_rng(5)
    models = [
        LinearModel(0.5 * rng.standard_normal((3, 3)), rng.standard_normal((2, 3)),
                    random_cov(rng, 3), random_cov(rng, 2))
        for _ in range(3)
    ]  # fmt: skip
    model = Periodic(*models)
    readings = [Reading(k, k) for k in range(1, STEPS + 1) if k % 4 == 0]
    found = posterior_bound(model, np.zeros(3), np.eye(3), TIMES, states(3), None, readings)
    expected = riccati(model, np.eye(3), lambda k: k % 4 == 0)
    np.testing.assert_allclose(found.cov, expected, rtol=1e-9)


def test_a_late_reading_counts_at_its_time_and_from_its_arrival_on():
    base = linear_model(1, 3, 2)
    base = replace(base, R=np.diag(np.diag(base.R)))  # the channels' noises are independent
    model = ChannelModel(base, {"now": [0], "late": [1]})
    readings = [Reading(k, k, ("now",)) for k in range(1, STEPS + 1)]
    readings += [Reading(k, k + 3, ("late",)) for k in range(2, STEPS - 2, 2)]
    u = np.zeros((STEPS, RUNS, 1))
    found = posterior_bound(model, np.zeros(3), np.eye(3), TIMES, states(3), u, readings)

    def filtered(end):
        """The covariance at a time from the readings that have arrived, fused in their order."""
        P = np.eye(3)
        for k in range(1, end + 1):
            P = base.A @ P @ base.A.T + base.Q
            here = [0] + [1] * any(
                r.taken == k and r.channels == ("late",) and r.arrives <= end for r in readings
            )
            C, R = base.C[here], base.R[np.ix_(here, here)]
            P = P - P @ C.T @ np.linalg.solve(C @ P @ C.T + R, C @ P)
        return P

    for k in (1, 4, 5, 6, 17, STEPS):
        np.testing.assert_allclose(found.cov[k], filtered(k), rtol=1e-9)


def pendulum(q: float = 1e-3, regular: bool = False) -> FunctionModel:
    """A pendulum of 0.1 s steps; the noise drives the rate alone, unless it is regular."""

    def f(x, u, t, dt):
        rate = x[..., 1] - 0.5 * np.sin(x[..., 0])
        return np.stack([x[..., 0] + 0.5 * rate, rate], axis=-1)

    Q = np.diag([q, q]) if regular else np.diag([0.0, q])
    return FunctionModel(f, lambda x, u, t: np.sin(x[..., :1]), Q, np.array([[0.01]]))


def simulate(model, P0, runs, steps, seed=0):
    rng = np.random.default_rng(seed)
    n, root = model.space.n, np.linalg.cholesky(model.Q + 1e-300 * np.eye(len(model.Q)))
    x = np.empty((steps + 1, runs, n))
    x[0] = rng.standard_normal((runs, n)) @ np.linalg.cholesky(P0).T
    for k in range(steps):
        step = model.transition(x[k], np.zeros((runs, 0)), float(k), 1.0)
        x[k + 1] = step + rng.standard_normal((runs, n)) @ root.T
    return x


def test_without_process_noise_it_is_the_bound_of_a_random_start():
    """V W⁻¹ Vᵀ of x₀ alone, V and W from products of the Jacobians over each run."""
    model, P0, steps = pendulum(0.0), 0.2 * np.eye(2), 12
    x = simulate(model, P0, 400, steps)
    found = posterior_bound(model, np.zeros(2), P0, np.arange(steps + 1.0), x)
    along, W, u = np.broadcast_to(np.eye(2), (400, 2, 2)), np.linalg.inv(P0), np.zeros((400, 0))
    for k in range(steps):
        along = model.transition_jacobian(x[k], u, float(k), 1.0)[1] @ along
        H = model.measurement_jacobian(x[k + 1], u, 0.0)[1] @ along
        W = W + (H.mT @ H).mean(axis=0) / 0.01
        V = along.mean(axis=0)
        np.testing.assert_allclose(found.cov[k + 1], V @ np.linalg.inv(W) @ V.T, rtol=1e-9)


def test_little_is_lost_by_keeping_few_variations():
    """The inequality with a variation for each of x₀ and w, none left out: a matrix that grows."""
    model, P0, steps, runs = pendulum(0.02), 0.2 * np.eye(2), 8, 400
    x, u = simulate(model, P0, runs, steps), np.zeros((runs, 0))
    found = posterior_bound(model, np.zeros(2), P0, np.arange(steps + 1.0), x)
    along = np.broadcast_to(np.eye(2), (runs, 2, 2))
    W, G = np.linalg.inv(P0), np.sqrt(0.02) * np.array([[0.0], [1.0]])
    for k in range(steps):
        F = model.transition_jacobian(x[k], u, float(k), 1.0)[1]
        along = np.concatenate([F @ along, np.broadcast_to(G, (runs, 2, 1))], axis=-1)
        W = np.block([[W, np.zeros((len(W), 1))], [np.zeros((1, len(W))), np.eye(1)]])
        H = model.measurement_jacobian(x[k + 1], u, 0.0)[1] @ along
        W = W + (H.mT @ H).mean(axis=0) / 0.01
        V = along.mean(axis=0)
        whole = V @ np.linalg.inv(W) @ V.T
        np.testing.assert_allclose(found.cov[k + 1].diagonal(), whole.diagonal(), rtol=0.03)


def growth(Q: float, R: float) -> FunctionModel:
    """The univariate growth model (Kitagawa 1987), with a linear measurement."""
    return FunctionModel(
        lambda x, u, t, dt: 0.5 * x + 25 * x / (1 + x**2) + 8 * np.cos(1.2 * t),
        lambda x, u, t: x, np.array([[Q]]), np.array([[R]]),
        f_jacobian=lambda x, u, t, dt: (0.5 + 25 * (1 - x**2) / (1 + x**2) ** 2)[..., None],
    )  # fmt: skip


@pytest.mark.parametrize(("Q", "R"), [(10.0, 1.0), (1.0, 1.0)])
def test_on_the_growth_model_it_is_between_tichavskys_recursion_and_the_best_filter(Q, R):
    """Tichavský et al. 1998, eq. 21, and the posterior variance on a grid, which no filter beats.

    It is seeded; a true bound fails one of the 20 comparisons of 4 standard errors in one of 1,500
    draws.
    """
    model, runs, steps, P0 = growth(Q, R), 1000, 10, np.eye(1)
    x, u = simulate(model, P0, runs, steps), np.zeros((runs, 0))
    found = posterior_bound(model, np.zeros(1), P0, np.arange(steps + 1.0), x).cov[:, 0, 0]
    J, theirs = 1.0, []
    for k in range(steps):
        F = model.transition_jacobian(x[k], u, float(k), 1.0)[1][:, 0, 0]
        J = 1 / Q + 1 / R - (F.mean() / Q) ** 2 / (J + (F**2).mean() / Q)
        theirs.append(1 / J)
    assert (found[1:] >= 0.99 * np.array(theirs)).all()
    assert found[1:].mean() > 1.0001 * np.mean(theirs)
    least = posterior_variances(model, x, Q, R)
    margin = 4 * least.std(axis=1) / np.sqrt(runs)
    assert (found[1:] < least.mean(axis=1) + margin).all()
    assert found[1:].mean() < least.mean() + 4 * least.mean(axis=0).std() / np.sqrt(runs)
    assert found[1:].mean() > 0.7 * least.mean()


def posterior_variances(model, x, Q, R):
    """Var(x | y₁ ... yₖ) `(step, run)` by numerical integration: its mean is the least error."""
    rng, grid = np.random.default_rng(7), np.linspace(-30, 30, 401)
    points, u = grid[:, None], np.zeros((len(grid), 0))
    p, out = np.exp(-0.5 * grid**2) * np.ones((x.shape[1], 1)), []
    for k in range(len(x) - 1):
        ahead = model.transition(points, u, float(k), 1.0)
        p = p @ np.exp(-0.5 * (grid - ahead) ** 2 / Q)
        y = x[k + 1] + np.sqrt(R) * rng.standard_normal((x.shape[1], 1))
        p = p * np.exp(-0.5 * (y - grid) ** 2 / R)
        p /= p.sum(axis=1, keepdims=True)
        out.append(p @ grid**2 - (p @ grid) ** 2)
    return np.array(out)


def test_tichavskys_variations_are_among_those_of_a_regular_noise():
    """One step of their recursion, for two coordinates: the family contains it."""
    model, runs = pendulum(0.05, regular=True), 3000
    x, u = simulate(model, np.eye(2), runs, 1), np.zeros((runs, 0))
    F = model.transition_jacobian(x[0], u, 0.0, 1.0)[1]
    H = model.measurement_jacobian(x[1], u, 0.0)[1]
    D = np.linalg.inv(model.Q)
    D11, D12 = (F.mT @ D @ F).mean(axis=0), -(F.mT @ D).mean(axis=0)
    J = D + (H.mT @ H).mean(axis=0) / 0.01 - D12.T @ np.linalg.solve(np.eye(2) + D11, D12)
    found = posterior_bound(model, np.zeros(2), np.eye(2), np.arange(2.0), x)
    assert np.linalg.eigvalsh(found.cov[1] - np.linalg.inv(J)).min() > -1e-9


def test_the_values_of_the_runs_give_the_error_of_the_expectation():
    """Over 60 repetitions of 50 runs; the standard deviation of each is known to 9%."""
    model, P0 = pendulum(0.02), 0.5 * np.eye(2)
    found = [
        posterior_bound(model, np.zeros(2), P0, np.arange(6.0), simulate(model, P0, 50, 5, seed))
        for seed in range(60)
    ]
    spread = np.std([b.cov[5].diagonal() for b in found], axis=0)
    told = np.mean([b.values[5].std(axis=0, ddof=1) for b in found], axis=0) / np.sqrt(50)
    np.testing.assert_allclose(told, spread, rtol=0.4)


def test_a_run_that_is_not_finite_does_not_count():
    model, P0 = pendulum(0.02), 0.5 * np.eye(2)
    x = simulate(model, P0, 20, 5)
    few = posterior_bound(model, np.zeros(2), P0, np.arange(6.0), x[:, 1:])
    x[3:, 0] = np.nan
    found = posterior_bound(model, np.zeros(2), P0, np.arange(6.0), x)
    assert np.isnan(found.values[3:, 0]).all()
    assert np.isfinite(found.values[:3]).all()
    assert np.isfinite(found.values[:, 1:]).all()
    np.testing.assert_allclose(found.cov[5], few.cov[5], rtol=0.1)
    x[4:] = np.nan
    found = posterior_bound(model, np.zeros(2), P0, np.arange(6.0), x)
    assert np.isfinite(found.cov[:4]).all()
    assert np.isnan(found.cov[4:]).all()


def test_mistakes():
    model, P0, x = pendulum(), np.eye(2), states(2)
    with pytest.raises(DimensionError, match=r"x has shape \(31, 5, 2\); expected \(5, run, 2\)"):
        posterior_bound(model, np.zeros(2), P0, np.arange(5.0), x)
    with pytest.raises(DimensionError, match="u has shape"):
        posterior_bound(model, np.zeros(2), P0, TIMES, x, np.zeros((STEPS, RUNS, 1)))
    with pytest.raises(DimensionError, match="taken at time 3 and arrives at 2; use 1 <= taken"):
        posterior_bound(model, np.zeros(2), P0, TIMES, x, None, [Reading(3, 2)])


def test_what_arrives_at_random_is_counted_run_by_run():
    """On a linear model the mean of Riccati's recursions, each with the readings of its run."""
    model, runs = linear_model(2, 3, 2), 12
    came = np.random.default_rng(3).random((STEPS + 1, runs)) < 0.4
    readings = [Reading(k, k, None, came[k]) for k in range(1, STEPS + 1)]
    u = np.zeros((STEPS, runs, 1))
    found = posterior_bound(model, np.zeros(3), np.eye(3), TIMES, states(3, runs), u, readings)
    each = np.array([riccati(model, np.eye(3), lambda k, i=i: came[k, i]) for i in range(runs)])
    np.testing.assert_allclose(found.cov, each.mean(axis=0), rtol=1e-9)
    diagonal = np.diagonal(each, axis1=2, axis2=3).swapaxes(0, 1)
    np.testing.assert_allclose(found.values, diagonal, rtol=1e-8)


def test_an_unstable_system_with_little_noise_is_steered():
    """The differences between the runs would otherwise grow with the unstable mode.

    The angle of an inverted pendulum, 0.2 rad at the start; the noise is so small that the filter
    forgets as fast as the system runs away. The extended filter's own variance is the measure.
    """

    def f(x, u, t, dt):
        rate = x[..., 1] + 0.2 * np.sin(x[..., 0]) - 0.25 * x[..., 0] - 0.25 * x[..., 1]
        return np.stack([x[..., 0] + 0.2 * rate, rate + 0.08 * x[..., 0] ** 3], axis=-1)

    model = FunctionModel(f, lambda x, u, t: x[..., :1], np.diag([0.0, 1e-5]), np.array([[0.01]]))
    P0, steps, runs = 0.04 * np.eye(2), 60, 200
    x = simulate(model, P0, runs, steps)
    found = posterior_bound(model, np.zeros(2), P0, np.arange(steps + 1.0), x)
    P, u = np.tile(P0, (runs, 1, 1)), np.zeros((runs, 0))
    for k in range(steps):
        F = model.transition_jacobian(x[k], u, float(k), 1.0)[1]
        P = F @ P @ F.mT + model.Q
        P = P - P[:, :, :1] @ P[:, :1] / (P[:, :1, :1] + 0.01)
    np.testing.assert_allclose(found.cov[-1].diagonal(), P.mean(axis=0).diagonal(), rtol=0.05)


def test_a_quaternion_has_the_bound_of_a_rotation_vector():
    """The attitude of a ball joint; an extended filter at the truth is the measure."""
    model = mujoco_model("ball", "additive", [0.0] * 3 + [0.1] * 3, differences=CENTERED,
                         channels=("attitude",))  # fmt: skip
    mj, steps = model.mjmodel, 20
    x0, u = random_states(mj, 30, scale=0.1)
    space, rng = layout.state_space(mj), np.random.default_rng(0)
    x, root = [x0], model.noise_response(x0, u, 0.0, 0.01)
    for k in range(steps):
        ahead = model.transition(x[-1], u, 0.01 * k, 0.01)
        x.append(space.plus(ahead, rng.standard_normal((30, 3)) @ root.T))
    rest = np.concatenate([mj.qpos0, np.zeros(3)])
    P0, times = 0.01 * np.eye(6), 0.01 * np.arange(steps + 1)
    controls = np.repeat(u[None], steps, axis=0)
    found = posterior_bound(model, rest, P0, times, np.array(x), controls).cov
    P, H = np.tile(P0, (30, 1, 1)), np.eye(6)[:3]
    for k in range(steps):
        F = model.transition_jacobian(x[k], u, 0.01 * k, 0.01)[1]
        P = F @ P @ F.mT + root @ root.T
        P = P - P[:, :, :3] @ np.linalg.solve(P[:, :3, :3] + 0.01 * np.eye(3), H @ P)
        linear = P.mean(axis=0).diagonal()
        np.testing.assert_allclose(found[k + 1].diagonal(), linear, rtol=0.02)


@pytest.mark.parametrize("scale", [1e9, 1e200])
def test_a_weight_without_a_factor_is_no_bound(scale):
    """A sum is known so well that rounding leaves its weight no factor; then beyond float64."""
    model = LinearModel(0.9 * np.eye(2), np.full((1, 2), scale), np.eye(2), np.eye(1))
    x = np.zeros((3, 3, 2))
    found = posterior_bound(model, np.zeros(2), np.eye(2), np.arange(3.0), x)
    assert np.isfinite(found.cov[0]).all()
    assert np.isnan(found.cov[1:]).all()
    assert np.isnan(found.values[1:]).all()
