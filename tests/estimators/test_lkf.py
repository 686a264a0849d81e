import numpy as np
import pytest

from estbench.errors import EstimatorError
from estbench.estimators.ekf import EKF
from estbench.estimators.lkf import LKF
from tests.helpers import mujoco_model, nonlinear_model, random_cov, random_states


def textbook_lkf(model, x0, P, ys, us, dt):
    """Source 002: x* by the model, δx and P by the linearization about it."""
    nominal, dx = x0, np.zeros(len(x0))
    for k, (y, u) in enumerate(zip(ys, us, strict=True)):
        F = model.f_jacobian(nominal, u, dt * k, dt)
        dx, P = F @ dx, F @ P @ F.T + model.Q
        nominal = model.f(nominal, u, dt * k, dt)
        H = model.h_jacobian(nominal, u, dt * (k + 1))
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + model.R)
        dx = dx + K @ (y - model.h(nominal, u, dt * (k + 1)) - H @ dx)
        P = (np.eye(len(x0)) - K @ H) @ P
    return nominal, dx, P


def problem(seed, n, runs=3, steps=10):
    rng = np.random.default_rng(seed)
    model = nonlinear_model(n)
    mean, cov = 0.5 * rng.standard_normal((runs, n)), 0.2 * random_cov(rng, n, runs)
    us = rng.standard_normal((steps, runs, 1))
    return model, mean, cov, rng.standard_normal((steps, runs, n // 2 + 1)), us


def drive(estimator, mean, cov, ys, us, dt=0.1):
    belief = estimator.init(mean, cov)
    for k, (y, u) in enumerate(zip(ys, us, strict=True)):
        belief = estimator.predict(belief, u, dt * k, dt)
        belief, _ = estimator.update(belief, y, u, dt * (k + 1))
    return belief


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("n", [2, 4, 6])
def test_equals_the_textbook(seed, n):
    model, mean, cov, ys, us = problem(seed, n)
    belief = drive(LKF(model), mean, cov, ys, us)
    for run in range(3):
        nominal, dx, P = textbook_lkf(model, mean[run], cov[run], ys[:, run], us[:, run], 0.1)
        np.testing.assert_allclose(belief.nominal[run], nominal, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(belief.mean[run], nominal + dx, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(belief.cov[run], P, rtol=1e-10, atol=1e-10)


def test_gains_do_not_depend_on_the_measurements():
    model, mean, cov, ys, us = problem(0, 4)
    a, b = (drive(LKF(model), mean, cov, y, us) for y in (ys, ys + 3.0))
    np.testing.assert_array_equal(a.cov, b.cov)
    assert not np.allclose(a.mean, b.mean)


def test_handed_over_from_the_start_it_is_the_ekf():
    model, mean, cov, ys, us = problem(1, 4)
    belief = drive(LKF(model, handover_time=0.0), mean, cov, ys, us)
    expected = drive(EKF(model), mean, cov, ys, us)
    np.testing.assert_allclose(belief.mean, expected.mean, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(belief.cov, expected.cov, rtol=1e-10, atol=1e-12)


def test_hand_over_time_switches_all_runs_at_that_time():
    model, mean, cov, ys, us = problem(2, 2)
    switched = drive(LKF(model, handover_time=0.5), mean, cov, ys, us)
    # The update at 0.5 s is the EKF's already.
    before = drive(LKF(model), mean, cov, ys[:4], us[:4])
    lkf, ekf = LKF(model), EKF(model)
    after = lkf.predict(before, us[4], 0.4, 0.1)
    assert not after.handed.any()
    for k in range(4, 10):
        if k > 4:
            after = ekf.predict(after, us[k], 0.1 * k, 0.1)
        after, _ = ekf.update(after, ys[k], us[k], 0.1 * (k + 1))
    assert switched.handed.all()
    np.testing.assert_allclose(switched.mean, after.mean, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(switched.cov, after.cov, rtol=1e-10, atol=1e-12)


def test_hand_over_by_deviation_is_each_runs_own():
    model, mean, cov, ys, us = problem(3, 2, steps=6)
    nominal = mean
    for k in range(6):
        nominal = model.f(nominal, us[k], 0.1 * k, 0.1)
        ys[k] = model.h(nominal, us[k], 0.1 * (k + 1))
    ys[:, 1] += 5.0
    estimator = LKF(model, handover_sigma=3.0)
    belief = drive(estimator, mean, cov, ys, us)
    np.testing.assert_array_equal(belief.handed, [False, True, False])
    plain = drive(LKF(model), mean, cov, ys, us)
    np.testing.assert_array_equal(belief.mean[[0, 2]], plain.mean[[0, 2]])
    assert not np.allclose(belief.mean[1], plain.mean[1])


def test_recovers_a_poor_start_on_a_curved_state_after_hand_over():
    model = mujoco_model("joints", "additive", 1e-6)
    truth, u = random_states(model.mjmodel, 4, seed=1)
    rng = np.random.default_rng(1)
    space = model.space
    cov = np.broadcast_to(0.04 * np.eye(space.n), (4, space.n, space.n))
    mean = space.plus(truth, 0.2 * rng.standard_normal((4, space.n)))
    estimator = LKF(model, handover_time=0.1)
    belief = estimator.init(mean, cov)
    seen = [i for i, name in enumerate(space.names) if "root" in name and i < space.n // 2][3:]
    for k in range(40):
        truth = model.transition(truth, u, 0.008 * k, 0.008)
        belief = estimator.predict(belief, u, 0.008 * k, 0.008)
        y = model.measurement(truth, u, 0.0)
        belief, _ = estimator.update(belief, y, u, 0.008 * (k + 1))
    assert not belief.fault.any()
    error = space.minus(truth, belief.mean)[:, seen]
    assert np.abs(error).max() < 0.1


@pytest.mark.parametrize("setting", ["handover_time", "handover_sigma"])
@pytest.mark.parametrize("value", [-1.0, "soon"])
def test_wrong_settings_are_refused(setting, value):
    with pytest.raises(EstimatorError, match=f"LKF: {setting} is"):
        LKF(nonlinear_model(2), **{setting: value})
