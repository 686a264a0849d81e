"""On a linear-Gaussian model the filters are the Kalman filter; masks and failures per run."""

from dataclasses import replace

import numpy as np
import pytest

from estbench.errors import DimensionError
from estbench.estimators import beliefs, registry
from estbench.estimators.beliefs import Fault, Gaussian
from estbench.estimators.update import mark_failed
from estbench.models.linear import LinearModel
from tests.helpers import EXACT, linear_model, nonlinear_model, random_cov

RUNS = 4
SETTINGS = [(name, {}) for name in EXACT] + [
    ("ekf", {"covariance_update": "simplified"}),
    ("ekf", {"covariance_update": "symmetric"}),
    ("ukf", {"alpha": 0.3, "beta": 0.0, "kappa": 1.0}),
    ("ukf", {"alpha": 0.9, "kappa": -0.5}),
]
every_filter = pytest.mark.parametrize(
    ("name", "settings"), SETTINGS, ids=["-".join([n, *map(str, s.values())]) for n, s in SETTINGS]
)
every_estimator = pytest.mark.parametrize("name", EXACT)
# seed, n, m, nu; few states, since a Gauss-Hermite rule takes order^n points
SIZES = [(0, 1, 1, 1), (1, 2, 1, 2), (2, 3, 2, 1), (3, 4, 3, 2), (4, 2, 4, 1), (5, 3, 3, 3)]


def start(model, seed, runs=RUNS):
    rng = np.random.default_rng(seed)
    n = model.space.n
    return rng, rng.standard_normal((runs, n)), random_cov(rng, n, runs)


def same(belief, other, filter, rows=slice(None), rtol=1e-10, atol=1e-12):
    np.testing.assert_allclose(filter.mean(belief)[rows], filter.mean(other)[rows], atol=atol)
    np.testing.assert_allclose(filter.cov(belief)[rows], filter.cov(other)[rows], atol=atol)


@every_filter
@pytest.mark.parametrize("size", SIZES)
def test_equals_the_kalman_filter(name, settings, size):
    model = linear_model(*size)
    filter = registry.create(name, settings, model)
    rng, x, P = start(model, size[0])
    belief = filter.init(x, P)
    books = list(zip(x, P))
    for step in range(6):
        u, y = rng.standard_normal((RUNS, size[3])), 3 * rng.standard_normal((RUNS, size[2]))
        belief = filter.predict(belief, u, float(step), 1.0)
        belief, innovation = filter.update(belief, y, u, step + 1.0)
        for i, (m, C) in enumerate(books):
            m, C = model.A @ m + model.B @ u[i], model.A @ C @ model.A.T + model.Q
            nu = y[i] - model.C @ m - model.D @ u[i]
            S = model.C @ C @ model.C.T + model.R
            K = C @ model.C.T @ np.linalg.inv(S)
            books[i] = m + K @ nu, C - K @ S @ K.T
            np.testing.assert_allclose(innovation.residual[i], nu, rtol=1e-10, atol=1e-10)
            np.testing.assert_allclose(innovation.cov[i], S, rtol=1e-10, atol=1e-10)
            np.testing.assert_allclose(innovation.nis[i], nu @ np.linalg.inv(S) @ nu, rtol=1e-8)
        np.testing.assert_allclose(
            filter.mean(belief), [m for m, _ in books], rtol=1e-10, atol=1e-10
        )
        np.testing.assert_allclose(
            filter.cov(belief), [C for _, C in books], rtol=1e-10, atol=1e-10
        )


def test_a_matrix_for_each_run():
    models = [linear_model(seed) for seed in range(RUNS)]
    stack = LinearModel(
        *(np.stack([getattr(m, k) for m in models]) for k in ("A", "C", "Q", "R", "B", "D"))
    )
    for name in ("ekf", "ukf"):
        filter = registry.create(name, {}, stack)
        rng, x, P = start(stack, 0)
        u, y = rng.standard_normal((RUNS, 1)), rng.standard_normal((RUNS, 2))
        together, _ = filter.update(filter.predict(filter.init(x, P), u, 0.0, 1.0), y, u, 1.0)
        for i, model in enumerate(models):
            row = slice(i, i + 1)
            alone = registry.create(name, {}, model)
            belief = alone.predict(alone.init(x[row], P[row]), u[row], 0.0, 1.0)
            belief, _ = alone.update(belief, y[row], u[row], 1.0)
            np.testing.assert_allclose(together.mean[row], belief.mean, rtol=1e-10, atol=1e-12)
            np.testing.assert_allclose(together.cov[row], belief.cov, rtol=1e-10, atol=1e-12)


def without(model, gone):
    """The model with one component of its measurement removed."""
    keep = [i for i in range(model.output().n) if i != gone]
    R = model.R[np.ix_(keep, keep)]
    if isinstance(model, LinearModel):
        return replace(model, C=model.C[keep], D=model.D[keep], R=R)
    h, jacobian = model.h, model.h_jacobian
    return replace(
        model, R=R, h=lambda *a: h(*a)[..., keep], h_jacobian=lambda *a: jacobian(*a)[..., keep, :]
    )


@every_filter
@pytest.mark.parametrize("model", [linear_model(7, 3, 3), nonlinear_model(4)], ids=["line", "bend"])
def test_a_masked_component_is_a_removed_one(name, settings, model):
    # Run i has component i masked, the last run none; R is correlated, and masked y may be NaN.
    filter = registry.create(name, settings, model)
    m = model.output().n
    rng, x, P = start(model, 0, m + 1)
    u, y = rng.standard_normal((m + 1, 1)), rng.standard_normal((m + 1, m))
    prior = filter.predict(filter.init(x, P), u, 0.0, 0.1)
    mask = ~np.eye(m + 1, m, dtype=bool)
    posterior, innovation = filter.update(prior, np.where(mask, y, np.nan), u, 0.1, None, mask)
    assert innovation.dof.tolist() == [m - 1] * m + [m]
    full, _ = filter.update(prior, y, u, 0.1)
    same(posterior, full, filter, rows=slice(m, None))
    for i in range(m):
        lesser = registry.create(name, settings, without(model, i))
        prior = lesser.predict(lesser.init(x, P), u, 0.0, 0.1)
        expected, other = lesser.update(prior, np.delete(y, i, axis=1), u, 0.1)
        same(posterior, expected, filter, rows=[i], rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(innovation.nis[i], other.nis[i], rtol=1e-9)
        np.testing.assert_array_equal(innovation.residual[i, i], 0.0)
        np.testing.assert_array_equal(innovation.white[i, i], 0.0)


@every_filter
def test_nothing_arrived_is_no_update(name, settings):
    model = nonlinear_model(4)
    filter = registry.create(name, settings, model)
    _, x, P = start(model, 1)
    prior, u = filter.init(x, P), np.ones((RUNS, 1))
    posterior, innovation = filter.update(
        prior, np.full((RUNS, 3), np.nan), u, 0.0, None, np.zeros((RUNS, 3), bool)
    )
    same(posterior, prior, filter, rtol=1e-10, atol=1e-13)
    assert not innovation.nis.any()
    assert not innovation.dof.any()


@every_estimator
def test_predict_and_update_leave_their_arguments_alone(name):
    model = nonlinear_model(4)
    filter = registry.create(name, {}, model)
    rng, x, P = start(model, 2)
    u, y = rng.standard_normal((RUNS, 1)), rng.standard_normal((RUNS, 3))
    y[0, 0] = np.nan
    mask = np.isfinite(y)
    arrays = (x, P, u, y, mask)
    copies = [a.copy() for a in arrays]
    first = filter.init(x, P)
    filter.update(filter.predict(first, u, 0.0, 0.1), y, u, 0.1, None, mask)
    for a, b in zip((*arrays, filter.mean(first), filter.cov(first)), (*copies, *copies[:2])):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-14)


def steps(filter, x, P, y, u, keys):
    belief = beliefs.start(filter, x, P, keys)
    for k in range(2):
        belief = filter.predict(belief, u, 0.1 * k, 0.1)
        belief, _ = filter.update(belief, y, u, 0.1 * (k + 1))
    return belief


@every_estimator
@pytest.mark.parametrize("model", [linear_model(8, 4, 3), nonlinear_model(4)], ids=["line", "bend"])
def test_a_failed_run_is_marked_and_the_others_are_bit_identical(name, model):
    filter = registry.create(name, {}, model)
    rng, x, P = start(model, 3, 7)
    u, y = rng.standard_normal((7, 1)), rng.standard_normal((7, 3))
    x[1, 2] = np.nan
    P[2] = np.nan
    P[3] *= -1e3
    y[4, 1] = np.nan
    good, keys = [0, 5, 6], np.arange(7, dtype=np.uint64)
    belief = steps(filter, x, P, y, u, keys)
    fault = belief.fault.tolist()
    assert [fault[i] for i in (*good, 1, 2, 4)] == [Fault.NONE] * 3 + [Fault.STATE] * 3
    # A filter that never factors P notices by its S.
    assert fault[3] in (Fault.COVARIANCE, Fault.INNOVATION)
    assert np.isnan(filter.mean(belief)[1:5]).all()
    assert np.isnan(filter.cov(belief)[1:5]).all()
    alone = steps(filter, x[good], P[good], y[good], u[good], keys[good])
    np.testing.assert_array_equal(filter.mean(belief)[good], filter.mean(alone))
    np.testing.assert_array_equal(filter.cov(belief)[good], filter.cov(alone))


@pytest.mark.parametrize(("name", "fault"), [("ekf", Fault.INNOVATION), ("ukf", Fault.COVARIANCE)])
def test_the_fault_of_an_indefinite_covariance(name, fault):
    model = linear_model(9)
    filter = registry.create(name, {}, model)
    _, x, P = start(model, 4, 2)
    P[1] *= -1e3
    belief = filter.init(x, P)
    belief, _ = filter.update(belief, np.zeros((2, 2)), np.zeros((2, 1)), 0.0)
    assert belief.fault.tolist() == [Fault.NONE, fault]
    # It stays failed, for the same reason, whatever follows.
    belief = filter.predict(belief, np.zeros((2, 1)), 0.0, 1.0)
    belief, _ = filter.update(belief, np.zeros((2, 2)), np.zeros((2, 1)), 1.0)
    assert belief.fault.tolist() == [Fault.NONE, fault]
    assert fault.text
    assert not Fault.NONE.text


def test_init_checks_shapes():
    filter = registry.create("ekf", {}, linear_model(0))
    for x, P in ((np.zeros(3), np.eye(3)), (np.zeros((2, 3)), np.eye(3)[None])):
        with pytest.raises(DimensionError, match=r"expected \(run, nx\), \(run, n, n\)"):
            filter.init(x, P)


@every_estimator
def test_constant_velocity_settles_at_alpha_and_beta(name):
    # Tracking index σ_w T²/σ_v = 1: α = 3/4, β = 1/2 (Kalata 1984; Bar-Shalom et al. 2001, 6.5.3).
    A, C = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0, 0.0]])
    model = LinearModel(A, C, np.array([[0.25, 0.5], [0.5, 1.0]]), np.eye(1))
    filter = registry.create(name, {}, model)
    belief, u = filter.init(np.zeros((1, 2)), 10 * np.eye(2)[None]), np.zeros((1, 0))
    for _ in range(60):
        belief = filter.predict(belief, u, 0.0, 1.0)
        before = filter.mean(belief)
        belief, innovation = filter.update(belief, before @ C.T + 1.0, u, 0.0)
    np.testing.assert_allclose(
        filter.cov(belief)[0], [[0.75, 0.5], [0.5, 1.0]], rtol=1e-10, atol=1e-10
    )
    np.testing.assert_allclose(
        (filter.mean(belief) - before)[0], [0.75, 0.5], rtol=1e-10, atol=1e-10
    )
    np.testing.assert_allclose(innovation.cov, [[[4.0]]], rtol=1e-10, atol=1e-10)  # S = R/(1 - α)


def test_marking_keeps_the_first_fault():
    belief = Gaussian(np.zeros((3, 1)), np.ones((3, 1, 1)), np.array([0, 2, 0], np.uint8))
    after = mark_failed(belief, np.array([0, 3, 3], np.uint8))
    assert after.fault.tolist() == [0, 2, 3]
    np.testing.assert_array_equal(np.isnan(after.mean[:, 0]), [False, True, True])
