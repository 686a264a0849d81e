"""What else FilterPy offers of ours, and where it is wrong; one run at a time.

Its KF, square-root, cubature and unscented filters are compared beside our tests of each.
"""

from dataclasses import replace

import numpy as np
import pytest
from filterpy.kalman import (
    CubatureKalmanFilter,
    IMMEstimator,
    KalmanFilter,
    MerweScaledSigmaPoints,
    SquareRootKalmanFilter,
    UnscentedKalmanFilter,
)

from estbench.estimators.adaptive import AdaptiveEKF
from estbench.estimators.ckf import CKF
from estbench.estimators.ekf import EKF
from estbench.estimators.imm import IMM
from estbench.estimators.ukf import UKF
from estbench.smoothers.rts import rts
from estbench.smoothers.urts import urts
from tests.helpers import linear_model, nonlinear_model, random_cov

STEPS, DT = 15, 0.1
CHAIN = np.array([[0.9, 0.1], [0.3, 0.7]])
seeds = pytest.mark.parametrize("seed", range(3))
sizes = pytest.mark.parametrize(("n", "m"), [(1, 1), (3, 2), (4, 5)])


def close(ours, theirs):
    np.testing.assert_allclose(ours, theirs, rtol=1e-10, atol=1e-10)


def problem(model, seed):
    """Prior, control `(1, nu)` and measurements `(step, 1, m)` of one run."""
    rng = np.random.default_rng(seed)
    mean, cov = 0.3 * rng.standard_normal((1, model.space.n)), random_cov(rng, model.space.n, 1)
    u = 0.3 * rng.standard_normal((1, model.nu))
    near = model.measurement(mean, u, 0.0)
    return mean, 0.1 * cov, u, near + 0.3 * rng.standard_normal((STEPS, 1, model.output().n))


def matrices(peer, model, mean, cov):
    peer.x, peer.P, peer.F, peer.H = mean.T.copy(), cov[0].copy(), model.A, model.C
    peer.Q, peer.R = model.Q, model.R
    return peer


def unscented(model, mean, cov, u, cls=UnscentedKalmanFilter, *points):
    n, m = model.space.n, model.output().n
    peer = cls(n, m, DT, lambda x: model.h(x, u[0], 0.0), lambda x, dt: model.f(x, u[0], 0.0, dt),
               *points)  # fmt: skip
    peer.x, peer.P, peer.Q, peer.R = mean[0].copy(), cov[0].copy(), model.Q, model.R
    return peer


def filtered(filter, mean, cov, u, ys):
    belief, posteriors = filter.init(mean, cov), []
    for y in ys:
        belief, _ = filter.update(filter.predict(belief, u, 0.0, DT), y, u, 0.0)
        posteriors.append(belief)
    return posteriors


def smoothed(smoother, model, posteriors, u, *rule):
    times = [k * DT for k in range(STEPS)]
    out = smoother(model, posteriors, [u] * (STEPS - 1), times, *rule)
    return [b.mean[0] for b in out], [b.cov[0] for b in out]


@seeds
@sizes
def test_rts_smoother(n, m, seed):
    model = linear_model(seed, n, m, nu=0)
    mean, cov, u, ys = problem(model, seed)
    posteriors = filtered(EKF(model), mean, cov, u, ys)
    peer = matrices(KalmanFilter(n, m), model, mean, cov)
    means, covs, _, _ = peer.batch_filter([y.T for y in ys])
    theirs = peer.rts_smoother(means, covs)
    ours = smoothed(rts, model, posteriors, u)
    close(ours[0], theirs[0][..., 0])
    close(ours[1], theirs[1])


@seeds
@pytest.mark.parametrize("n", [2, 4])
def test_unscented_rts_smoother(n, seed):
    model = nonlinear_model(n)
    mean, cov, u, ys = problem(model, seed)
    filter = UKF(model, True, 0.5, 2.0, 1.0)
    posteriors = filtered(filter, mean, cov, u, ys)
    points = MerweScaledSigmaPoints(n, 0.5, 2.0, 1.0)
    peer = unscented(model, mean, cov, u, UnscentedKalmanFilter, points)
    means, covs = peer.batch_filter([y[0] for y in ys])
    ours = smoothed(urts, model, posteriors, u, lambda k: filter.rule)
    theirs = peer.rts_smoother(means, covs)
    close(ours[0], theirs[0])
    close(ours[1], theirs[1])


@seeds
@sizes
def test_fading_memory(n, m, seed):
    model = linear_model(seed, n, m, nu=0)
    mean, cov, u, ys = problem(model, seed)
    posteriors = filtered(AdaptiveEKF(model, adapt="none", fading=1.05), mean, cov, u, ys)
    peer = matrices(KalmanFilter(n, m), model, mean, cov)
    peer.alpha = 1.05
    for y, belief in zip(ys, posteriors):
        peer.predict()
        peer.update(y.T)
        close(belief.mean[0], peer.x[:, 0])
        close(belief.cov[0], peer.P)


def mode_models(seed, n, m):
    """Two models that differ in everything: dynamics, sensors and both noises."""
    return [linear_model(seed + k, n, m, nu=0) for k in (0, 10)]


@seeds
@sizes
def test_interacting_multiple_models(n, m, seed):
    models = mode_models(seed, n, m)
    mean, cov, u, ys = problem(models[0], seed)
    filter = IMM(models[0], models, CHAIN)
    belief = filter.init(mean, cov)
    bank = [matrices(KalmanFilter(n, m), model, mean, cov) for model in models]
    peer = IMMEstimator(bank, [0.5, 0.5], CHAIN)
    for y in ys:
        prior = filter.predict(belief, u, 0.0, DT)
        belief, _ = filter.update(prior, y, u, 0.0)
        peer.predict()
        peer.update(y.T)
        close(belief.probability[0], peer.mu)
        close(filter.mean(belief)[0], peer.x[:, 0])
        close(filter.cov(belief)[0], peer.P)


def test_its_imm_combines_the_prior_with_the_probabilities_of_the_step_before():
    models = mode_models(0, 3, 2)
    mean, cov, u, _ = problem(models[0], 0)
    filter = IMM(models[0], models, CHAIN)
    prior = filter.predict(filter.init(mean, cov), u, 0.0, DT)
    bank = [matrices(KalmanFilter(3, 2), model, mean, cov) for model in models]
    peer = IMMEstimator(bank, [0.5, 0.5], CHAIN)
    peer.predict()
    right = sum(mu * one.x[:, 0] for mu, one in zip([0.5, 0.5] @ CHAIN, bank))
    close(filter.mean(prior)[0], right)
    assert np.abs(peer.x_prior[:, 0] - right).max() > 1e-3


def test_its_square_root_filter_answers_the_prior_for_the_posterior():
    model = linear_model(0, 3, 2, nu=0)
    model = replace(model, Q=model.Q + 0.1 * np.eye(3))  # it needs a Cholesky factor of Q
    mean, cov, _, ys = problem(model, 0)
    peer = matrices(SquareRootKalmanFilter(3, 2), model, mean, cov)
    peer.predict()
    prior = peer.P.copy()
    peer.update(ys[0].T)
    close(peer.P_post, prior)
    assert np.abs(peer.P - prior).max() > 1e-2


def test_its_cubature_filter_does_not_redraw():
    model = nonlinear_model(4)
    mean, cov, u, ys = problem(model, 0)
    peer = unscented(model, mean, cov, u, CubatureKalmanFilter)
    peer.x = peer.x[:, None]
    peer.predict()
    peer.update(ys[0].T)
    kept, redrawn = (
        filtered(CKF(model, redraw), mean, cov, u, ys[:1])[0] for redraw in (False, True)
    )
    close(kept.cov[0], peer.P)
    assert np.abs(redrawn.cov[0] - peer.P).max() > 1e-4
