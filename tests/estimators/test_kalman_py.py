"""Against kalman-py, whose filters take one run and a prior before the first prediction."""

import numpy as np
import pytest
from kalman_py import ExtendedKalmanFilter, KalmanFilter, UnscentedKalmanFilter
from kalman_py import diagnostics as their

from estbench.consistency.nees import chi_square_band
from estbench.estimators import registry
from estbench.smoothers.rts import gaussian, rts
from estbench.smoothers.urts import urts
from estbench.spaces.linalg import quadratic_form
from tests.helpers import linear_model, nonlinear_model, random_cov

RUNS, STEPS, DT = 2, 20, 0.1
seeds = pytest.mark.parametrize("seed", range(3))
dimensions = pytest.mark.parametrize("n", [2, 4, 6])
LINEAR = [(name, root) for name in ("kf", "ekf", "iekf", "ukf", "ckf") for root in (False, True)]
LINEAR += [("lkf", False), ("sr_ekf", True), ("sr_ukf", True), ("ghkf", False)]
RULES = [(1.0, 2.0, 0.0), (0.5, 2.0, 1.0), (0.7, 3.0, -1.0)]


def close(ours, theirs):
    np.testing.assert_allclose(ours, theirs, rtol=1e-10, atol=1e-10)


def linear_peer(model, mean, cov, u, root):
    """F, H without controls: kalman-py has no B and D."""
    return KalmanFilter(model.A, model.C, model.Q, model.R, mean, cov, square_root=root)


def extended_peer(model, mean, cov, u, root):
    return ExtendedKalmanFilter(
        lambda x, dt: model.f(x, u, 0.0, dt), lambda x: model.h(x, u, 0.0),
        model.Q, model.R, mean, cov, square_root=root,
        jac_f=lambda x, dt: model.f_jacobian(x, u, 0.0, dt),
        jac_h=lambda x: model.h_jacobian(x, u, 0.0),
    )  # fmt: skip


def unscented_peer(model, mean, cov, u, root, rule=(1.0, 2.0, 0.0)):
    alpha, beta, kappa = rule
    return UnscentedKalmanFilter(
        lambda x, dt: model.f(x, u, 0.0, dt), lambda x: model.h(x, u, 0.0),
        model.Q, model.R, mean, cov, alpha=alpha, beta=beta, kappa=kappa, square_root=root,
    )  # fmt: skip


def problem(model, seed):
    """Priors, a control held throughout `(run, nu)`, and measurements `(step, run, m)`."""
    rng = np.random.default_rng(seed)
    n, m = model.space.n, model.output().n
    mean, cov = 0.3 * rng.standard_normal((RUNS, n)), 0.1 * random_cov(rng, n, RUNS)
    u = 0.3 * rng.standard_normal((RUNS, model.nu))
    near = model.measurement(mean, u, 0.0)
    return mean, cov, u, near + 0.3 * rng.standard_normal((STEPS, RUNS, m))


def check(filter, peers, mean, cov, u, ys, steps=()):
    """Priors, posteriors and NIS of every step and run; returns ours and theirs."""
    belief, posteriors = filter.init(mean, cov), []
    results = [peer.filter(ys[:, i], *steps) for i, peer in enumerate(peers)]
    for k, y in enumerate(ys):
        prior = filter.predict(belief, u, 0.0, DT)
        belief, innovation = filter.update(prior, y, u, 0.0)
        posteriors.append(belief)
        for i, result in enumerate(results):
            close(filter.mean(prior)[i], result.predicted_means[k])
            close(filter.cov(prior)[i], result.predicted_covs[k])
            close(filter.mean(belief)[i], result.means[k])
            close(filter.cov(belief)[i], result.covs[k])
            close(innovation.nis[i], result.nis[k])
    return posteriors, results


def check_smoothed(smoother, model, posteriors, peers, results, u):
    times = [k * DT for k in range(STEPS)]
    smoothed = smoother(model, [gaussian(b) for b in posteriors], [u] * (STEPS - 1), times)
    for i, (peer, result) in enumerate(zip(peers, results)):
        theirs = peer.smooth(result)
        close([belief.mean[i] for belief in smoothed], theirs.means)
        close([belief.cov[i] for belief in smoothed], theirs.covs)


@seeds
@pytest.mark.parametrize(("n", "m"), [(1, 1), (3, 2), (4, 5)])
@pytest.mark.parametrize(("name", "root"), LINEAR)
def test_linear_family(name, root, n, m, seed):
    model = linear_model(seed, n, m, nu=0)
    mean, cov, u, ys = problem(model, seed)
    filter = registry.create(name, {}, model)
    peers = [linear_peer(model, mean[i], cov[i], u[i], root) for i in range(RUNS)]
    posteriors, results = check(filter, peers, mean, cov, u, ys)
    if name in ("kf", "sr_ekf"):
        check_smoothed(rts, model, posteriors, peers, results, u)


@seeds
@dimensions
@pytest.mark.parametrize("name", ["ekf", "sr_ekf"])
@pytest.mark.parametrize("root", [False, True])
def test_extended_filter_and_smoother(name, root, n, seed):
    model = nonlinear_model(n)
    mean, cov, u, ys = problem(model, seed)
    filter = registry.create(name, {}, model)
    peers = [extended_peer(model, mean[i], cov[i], u[i], root) for i in range(RUNS)]
    posteriors, results = check(filter, peers, mean, cov, u, ys, [DT])
    check_smoothed(rts, model, posteriors, peers, results, u)


@seeds
@dimensions
@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("name", ["ukf", "sr_ukf"])
def test_unscented_filter_and_smoother(name, rule, n, seed):
    model = nonlinear_model(n)
    mean, cov, u, ys = problem(model, seed)
    filter = registry.create(name, dict(zip(("alpha", "beta", "kappa"), rule)), model)
    root = name == "sr_ukf"
    peers = [unscented_peer(model, mean[i], cov[i], u[i], root, rule) for i in range(RUNS)]
    posteriors, results = check(filter, peers, mean, cov, u, ys, [DT])

    def smoother(*passage):
        return urts(*passage, lambda k: filter.rule)

    check_smoothed(smoother, model, posteriors, peers, results, u)


@seeds
@dimensions
def test_cubature_is_its_unscented_filter_without_a_centre(n, seed):
    """α = 1, β = κ = 0 leave the central point no weight."""
    model = nonlinear_model(n)
    mean, cov, u, ys = problem(model, seed)
    peers = [unscented_peer(model, mean[i], cov[i], u[i], False, (1.0, 0.0, 0.0)) for i in (0, 1)]
    check(registry.create("ckf", {}, model), peers, mean, cov, u, ys, [DT])


@seeds
def test_nees_and_its_band(seed):
    rng = np.random.default_rng(seed)
    error, cov = rng.standard_normal((5, 4)), random_cov(rng, 4, 5)
    close(quadratic_form(cov, error), their.nees(error, np.zeros((5, 4)), cov))
    for dof, runs in ((1, 1), (4, 50), (12, 1000)):
        close(chi_square_band(dof, runs), their.chi2_bounds(dof, runs))


def test_where_they_part_a_reading_that_did_not_arrive():
    """kalman-py takes NaN for a number, and is NaN from then on; here it is a mask."""
    model = linear_model(0, nu=0)
    mean, cov, u, ys = problem(model, 0)
    peer = linear_peer(model, mean[0], cov[0], u[0], False)
    filter = registry.create("kf", {}, model)
    ys[3, 0, 0] = np.nan
    assert np.isnan(peer.filter(ys[:, 0]).means[3:]).all()
    belief = filter.init(mean[:1], cov[:1])
    for y in ys[:, :1]:
        belief, _ = filter.update(filter.predict(belief, u[:1], 0.0, DT), y, u[:1], 0.0,
                                  None, np.isfinite(y))  # fmt: skip
        peer.predict()
        seen = np.isfinite(y[0])
        peer.update(y[0, seen], model.C[seen], model.R[np.ix_(seen, seen)])  # a smaller H instead
    close(filter.mean(belief)[0], peer.x)
    close(filter.cov(belief)[0], peer.P)
