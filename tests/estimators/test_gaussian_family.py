"""What every Gaussian filter of the family must do, whatever its algorithm."""

import numpy as np
import pytest

from estbench.budgets.accounting import gain
from estbench.estimators import beliefs
from estbench.estimators.beliefs import Fault
from estbench.estimators.ckf import CKF
from estbench.estimators.diplf import DIPLF
from estbench.estimators.ekf import EKF
from estbench.estimators.ghkf import GHKF
from estbench.estimators.iekf import IEKF
from estbench.estimators.iplf import IPLF
from estbench.estimators.kf import KF
from estbench.estimators.lkf import LKF
from estbench.estimators.rotated_ukf import RotatedUKF
from estbench.estimators.sr_ekf import SquareRootEKF
from estbench.estimators.sr_ukf import SquareRootUKF
from estbench.estimators.ukf import UKF
from estbench.models.function import FunctionModel
from estbench.models.linear import LinearModel
from tests.helpers import linear_model, mujoco_model, nonlinear_model, random_cov, random_states

FAMILY = {
    "ekf": EKF,
    "ukf": UKF,
    "kf": KF,
    "lkf": LKF,
    "lkf_handed": lambda model: LKF(model, handover_time=0.3, handover_sigma=1.0),
    "sr_ekf": SquareRootEKF,
    "iekf": IEKF,
    "sr_ukf": SquareRootUKF,
    "sr_ukf_downdated": lambda model: SquareRootUKF(model, alpha=0.5),
    "ckf": CKF,
    "ghkf": GHKF,
    "rotated_ukf": RotatedUKF,
    "iplf": IPLF,
    "diplf": DIPLF,
    "diplf_ukf": lambda model: DIPLF(model, base="ukf", iterations=3, measurement_iterations=2),
    "iplf_rotated": lambda model: IPLF(model, base="rotated_ukf"),
    "rotated_ukf_thrice": lambda model: RotatedUKF(model, centre_weight=0.25, rotations=3),
}
family = pytest.mark.parametrize("name", FAMILY)


def start(seed, model, runs):
    rng = np.random.default_rng(seed)
    mean = 0.3 * rng.standard_normal((runs, model.space.nx))
    return rng, mean, 0.1 * random_cov(rng, model.space.n, runs)


def drive(name, model, mean, cov, ys, us, mask=None, rows=None):
    """The rows are the numbers of the runs, by default 0, 1, ..."""
    estimator = FAMILY[name](model)
    keys = np.arange(len(mean)) if rows is None else rows
    belief, innovations = beliefs.start(estimator, mean, cov, np.asarray(keys, np.uint64)), []
    for k, (y, u) in enumerate(zip(ys, us, strict=True)):
        belief = estimator.predict(belief, u, 0.1 * k, 0.1)
        belief, innovation = estimator.update(belief, y, u, 0.1 * (k + 1), None, mask)
        innovations.append(innovation)
    return estimator, belief, innovations


def textbook_kf(model, x, P, ys, us):
    A, B, C, D, Q, R = model.A, model.B, model.C, model.D, model.Q, model.R
    nis = []
    for y, u in zip(ys, us, strict=True):
        x, P = A @ x + B @ u, A @ P @ A.T + Q
        S = C @ P @ C.T + R
        K = P @ C.T @ np.linalg.inv(S)
        v = y - C @ x - D @ u
        x, P = x + K @ v, P - K @ S @ K.T
        nis.append(v @ np.linalg.inv(S) @ v)
    return x, P, np.array(nis)


@family
@pytest.mark.parametrize(("n", "m"), [(1, 1), (3, 2), (4, 5)])
@pytest.mark.parametrize("seed", range(3))
def test_is_the_kalman_filter_on_a_linear_gaussian_model(name, seed, n, m):
    model = linear_model(seed, n, m)
    rng, mean, cov = start(seed, model, 4)
    ys, us = rng.standard_normal((8, 4, m)), rng.standard_normal((8, 4, 1))
    estimator, belief, innovations = drive(name, model, mean, cov, ys, us)
    for run in range(4):
        x, P, nis = textbook_kf(model, mean[run], cov[run], ys[:, run], us[:, run])
        np.testing.assert_allclose(estimator.mean(belief)[run], x, rtol=0, atol=1e-10)
        np.testing.assert_allclose(estimator.cov(belief)[run], P, rtol=0, atol=1e-10)
        np.testing.assert_allclose([i.nis[run] for i in innovations], nis, rtol=1e-8)


@family
def test_innovation_is_white_and_its_parts_agree(name):
    model = nonlinear_model(4)
    rng, mean, cov = start(1, model, 5)
    ys, us = rng.standard_normal((1, 5, 3)), rng.standard_normal((1, 5, 1))
    _, _, (innovation,) = drive(name, model, mean, cov, ys, us)
    lower = np.linalg.cholesky(innovation.cov)
    white = np.linalg.solve(lower, innovation.residual[..., None])[..., 0]
    np.testing.assert_allclose(innovation.white, white, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(innovation.nis, (white**2).sum(axis=-1), rtol=1e-10, atol=1e-10)
    assert (innovation.dof == 3).all()


@family
@pytest.mark.parametrize("n", [2, 4])
def test_covariance_stays_symmetric_and_positive_definite(name, n):
    model = nonlinear_model(n)
    rng, mean, cov = start(n, model, 6)
    x = mean + 0.1 * rng.standard_normal(mean.shape)
    us, ys = rng.standard_normal((60, 6, 1)), []
    for u in us:
        x = model.transition(x, u, 0.0, 0.1) + 0.05 * rng.standard_normal(x.shape)
        ys.append(model.measurement(x, u) + 0.1 * rng.standard_normal((6, n // 2 + 1)))
    estimator, belief, _ = drive(name, model, mean, cov, ys, us)
    P = estimator.cov(belief)
    assert not belief.fault.any()
    np.testing.assert_allclose(P, np.swapaxes(P, -1, -2), rtol=0, atol=1e-14)
    assert (np.linalg.eigvalsh(P) > 0).all()


def without(model, mask):
    """The model that has only the components of the mask."""

    def chosen(function):
        return None if function is None else lambda *a: function(*a)[..., mask, :]

    if isinstance(model, LinearModel):
        assert model.D is not None
        R = model.R[np.ix_(mask, mask)]
        return LinearModel(model.A, model.C[mask], model.Q, R, model.B, model.D[mask])
    return FunctionModel(
        model.f, lambda *a: model.h(*a)[..., mask], model.Q, model.R[np.ix_(mask, mask)], 1,
        model.f_jacobian, chosen(model.h_jacobian),
    )  # fmt: skip


@family
@pytest.mark.parametrize("model", [linear_model(3, 3, 3), nonlinear_model(4)])
def test_a_mask_is_the_model_without_the_component(name, model):
    rng, mean, cov = start(2, model, 4)
    us = rng.standard_normal((3, 4, 1))
    ys = rng.standard_normal((3, 4, 3))
    present = np.array([[True] * 3, [True, False, True], [False, False, True], [False] * 3])
    hidden = np.where(present, ys, np.nan)
    estimator, belief, innovations = drive(name, model, mean, cov, hidden, us, present)
    assert not belief.fault.any()
    for run, mask in enumerate(present):
        row = slice(run, run + 1)
        if not mask.any():
            for innovation in innovations:
                assert innovation.dof[run] == 0
                assert innovation.nis[run] == 0.0
                assert not innovation.residual[run].any()
            continue
        small, reduced, expected = drive(
            name, without(model, mask), mean[row], cov[row], ys[:, row][..., mask], us[:, row],
            rows=[run],
        )  # fmt: skip
        close = {"rtol": 0, "atol": 1e-10}
        np.testing.assert_allclose(estimator.mean(belief)[row], small.mean(reduced), **close)
        np.testing.assert_allclose(estimator.cov(belief)[row], small.cov(reduced), **close)
        for innovation, other in zip(innovations, expected, strict=True):
            assert innovation.dof[run] == mask.sum()
            np.testing.assert_allclose(innovation.nis[row], other.nis, rtol=1e-8)
            np.testing.assert_allclose(innovation.white[run][mask], other.white[0], **close)
            np.testing.assert_array_equal(innovation.white[run][~mask], 0.0)
            S = innovation.cov[run]
            np.testing.assert_array_equal(S[~mask], np.eye(3)[~mask])


@family
def test_nothing_arrived_leaves_the_belief(name):
    model = nonlinear_model(4)
    _, mean, cov = start(3, model, 3)
    estimator = FAMILY[name](model)
    belief = estimator.init(mean, cov)
    mask = np.zeros((3, 3), bool)
    after, _ = estimator.update(belief, np.full((3, 3), np.nan), np.zeros((3, 1)), 0.0, None, mask)
    np.testing.assert_array_equal(estimator.mean(after), mean)
    np.testing.assert_allclose(estimator.cov(after), cov, rtol=0, atol=1e-14)


@family
def test_a_failed_run_is_marked_and_leaves_the_others_alone(name):
    model = nonlinear_model(4)
    rng, mean, cov = start(4, model, 5)
    ys, us = rng.standard_normal((4, 5, 3)), rng.standard_normal((4, 5, 1))
    few = [0, 3]
    alone, expected, _ = drive(name, model, mean[few], cov[few], ys[:, few], us[:, few], rows=few)
    broken_mean, broken_ys = mean.copy(), ys.copy()
    broken_mean[1] = np.nan
    broken_ys[2, 2] = np.inf
    broken_ys[1, 4] = np.nan
    with np.errstate(invalid="ignore"):  # as the event loop does
        estimator, belief, _ = drive(name, model, broken_mean, cov, broken_ys, us)
    mean, cov = estimator.mean(belief), estimator.cov(belief)
    np.testing.assert_array_equal(belief.fault, [0, *[Fault.STATE] * 2, 0, Fault.STATE])
    assert np.isnan(mean[[1, 2, 4]]).all()
    assert np.isnan(cov[[1, 2, 4]]).all()
    np.testing.assert_allclose(mean[[0, 3]], alone.mean(expected), rtol=0, atol=1e-12)
    np.testing.assert_allclose(cov[[0, 3]], alone.cov(expected), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    "name",
    ["ukf", "sr_ekf", "sr_ukf", "sr_ukf_downdated", "ckf", "ghkf", "rotated_ukf", "iplf"],
)
def test_an_indefinite_covariance_is_named(name):
    model = nonlinear_model(4)
    rng, mean, cov = start(5, model, 3)
    cov[1] = np.diag([1.0, -0.5, 1.0, 1.0])
    ys, us = rng.standard_normal((2, 3, 3)), np.zeros((2, 3, 1))
    _, belief, _ = drive(name, model, mean, cov, ys, us)
    np.testing.assert_array_equal(belief.fault, [0, Fault.COVARIANCE, 0])


CURVED = {
    # Difference Jacobians magnify rounding by 1/step = 1e6.
    "sr_ekf": ("ekf", 1e-7),
    "lkf_handed_at_once": ("ekf", 1e-7),
    "iekf_once": ("ekf", 1e-7),
    "iplf_once": ("ukf", 1e-9),
    "sr_ukf": ("ukf", 1e-9),
}


@pytest.mark.parametrize("name", CURVED)
@pytest.mark.parametrize("masked", [False, True])
def test_agrees_with_its_plain_form_on_a_curved_state(name, masked):
    peer, tolerance = CURVED[name]
    build = FAMILY | {
        "lkf_handed_at_once": lambda model: LKF(model, handover_time=0.0),
        "iekf_once": lambda model: IEKF(model, iterations=1),
        "iplf_once": lambda model: IPLF(model, iterations=1),
    }
    model = mujoco_model("joints", "additive", 0.01)
    rng = np.random.default_rng(6)
    x, u = random_states(model.mjmodel, 3, seed=6)
    cov = 0.05 * random_cov(rng, model.space.n, 3)
    y = model.measurement(random_states(model.mjmodel, 3, seed=7)[0], u, 0.0)
    m = model.output().n
    mask = rng.random((3, m)) < 0.7 if masked else None
    results = []
    for label in (name, peer):
        estimator = build[label](model)
        belief = estimator.init(x, cov)
        for k in range(3):
            belief = estimator.predict(belief, u, 0.008 * k, 0.008)
            belief, innovation = estimator.update(belief, y, u, 0.008 * (k + 1), None, mask)
        assert not belief.fault.any()
        results.append((estimator.mean(belief), estimator.cov(belief), innovation.nis))
    for ours, theirs in zip(*results, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("name", [name for name in FAMILY if name != "ghkf"])
def test_a_failed_run_leaves_the_others_alone_on_a_curved_state(name):
    model = mujoco_model("joints", "additive", 0.01)
    x, u = random_states(model.mjmodel, 3, seed=10)
    cov = 0.02 * random_cov(np.random.default_rng(10), model.space.n, 3)
    y = model.measurement(random_states(model.mjmodel, 3, seed=11)[0], u, 0.0)
    x[1] = np.nan
    good = [0, 2]

    def last(x, cov, y, u, rows=(0, 1, 2)):
        estimator = FAMILY[name](model)
        belief = beliefs.start(estimator, x, cov, np.array(rows, np.uint64))
        for k in range(3):
            belief = estimator.predict(belief, u, 0.008 * k, 0.008)
            belief, _ = estimator.update(belief, y, u, 0.008 * (k + 1))
        return estimator.mean(belief), estimator.cov(belief), belief.fault

    mean, P, fault = last(x, cov, y, u)
    np.testing.assert_array_equal(fault, [0, Fault.STATE, 0])
    assert np.isnan(mean[1]).all()
    alone = last(x[good], cov[good], y[good], u[good], good)
    np.testing.assert_allclose(mean[good], alone[0], rtol=0, atol=1e-11)
    np.testing.assert_allclose(P[good], alone[1], rtol=0, atol=1e-11)


def test_cubature_is_the_unscented_rule_without_its_centre_on_a_curved_state():
    model = mujoco_model("joints", "additive", 0.01)
    x, u = random_states(model.mjmodel, 2, seed=8)
    cov = 0.01 * random_cov(np.random.default_rng(8), model.space.n, 2)
    y = model.measurement(random_states(model.mjmodel, 2, seed=9)[0], u, 0.0)
    results = []
    for estimator in (CKF(model), UKF(model, alpha=1.0, beta=0.0, kappa=0.0)):
        belief = estimator.predict(estimator.init(x, cov), u, 0.0, 0.008)
        belief, innovation = estimator.update(belief, y, u, 0.008)
        results.append((belief.mean, belief.cov, innovation.nis))
    for ours, theirs in zip(*results, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9)


@family
def test_the_gain_that_it_shows(name):
    """K = P⁻ Hᵀ S⁻¹ on a linear model, with a zero column where a component did not arrive."""
    model, runs = linear_model(7), 4
    rng, mean, cov = start(7, model, runs)
    y, u = rng.standard_normal((runs, 2)), rng.standard_normal((runs, 1))
    mask = np.array([[True, True], [True, False], [False, True], [True, True]])
    estimator = FAMILY[name](model)
    prior = estimator.predict(beliefs.start(estimator, mean, cov), u, 0.0, 0.1)
    x, P = estimator.mean(prior), estimator.cov(prior)
    posterior, innovation = estimator.update(prior, y, u, 0.1, None, mask)
    K, H = gain(innovation), model.C
    assert K is not None
    for run in range(runs):
        here = H[mask[run]]
        S = here @ P[run] @ here.T + model.R[np.ix_(mask[run], mask[run])]
        expected = np.zeros((3, 2))
        expected[:, mask[run]] = np.linalg.solve(S, here @ P[run]).T
        np.testing.assert_allclose(K[run], expected, rtol=0, atol=1e-10)
    change = estimator.mean(posterior) - x
    v = np.where(mask, y - model.measurement(x, u), 0.0)
    np.testing.assert_allclose(change, (K @ v[..., None])[..., 0], rtol=0, atol=1e-10)
