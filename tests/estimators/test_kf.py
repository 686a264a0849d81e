from typing import Any

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter

from estbench.errors import EstimatorError
from estbench.estimators.ekf import EKF
from estbench.estimators.kf import KF, tangent_map
from estbench.experiment import setup
from estbench.models.differences import Differences
from estbench.models.function import FunctionModel
from estbench.models.linear import LinearModel
from estbench.montecarlo import run as experiment
from tests.helpers import linear_model, mujoco_model, nonlinear_model, random_cov, random_states


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("n", "m", "nu"), [(1, 1, 0), (2, 3, 1), (5, 2, 2)])
def test_equals_filterpy(seed, n, m, nu):
    rng = np.random.default_rng(seed)
    model: Any = linear_model(seed, n, m, nu)
    mean, cov = rng.standard_normal((1, n)), random_cov(rng, n, 1)
    peer: Any = KalmanFilter(n, m, nu)
    peer.x, peer.P, peer.F, peer.H = mean[0, :, None], cov[0], model.A, model.C
    peer.Q, peer.R, peer.B = model.Q, model.R, model.B
    estimator = KF(model)
    belief = estimator.init(mean, cov)
    for k in range(15):
        u, y = rng.standard_normal((1, nu)), rng.standard_normal((1, m))
        belief = estimator.predict(belief, u, 0.1 * k, 0.1)
        belief, innovation = estimator.update(belief, y, u, 0.1 * (k + 1))
        peer.predict(u.T)
        peer.update((y - u @ model.D.T).T)
        np.testing.assert_allclose(belief.mean[0], peer.x[:, 0], rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(belief.cov[0], peer.P, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(innovation.cov[0], peer.S, rtol=1e-10, atol=1e-10)


def test_matrices_of_each_run_are_used():
    rng = np.random.default_rng(0)
    A = rng.standard_normal((4, 2, 2))
    shared = linear_model(0, 2, 1)
    model = LinearModel(A, shared.C, shared.Q, shared.R)
    mean, cov, u = rng.standard_normal((4, 2)), random_cov(rng, 2, 4), np.zeros((4, 0))
    belief = KF(model).predict(KF(model).init(mean, cov), u, 0.0, 1.0)
    np.testing.assert_allclose(belief.mean, (A @ mean[..., None])[..., 0], rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(
        belief.cov, A @ cov @ np.swapaxes(A, -1, -2) + model.Q, rtol=1e-10, atol=1e-12
    )


class Counting:
    """A model that counts its linearizations."""

    def __init__(self, model):
        self._model, self.count = model, 0

    def __getattr__(self, name):
        return getattr(self._model, name)

    def transition_jacobian(self, *a):
        self.count += 1
        return self._model.transition_jacobian(*a)

    def measurement_jacobian(self, *a):
        self.count += 1
        return self._model.measurement_jacobian(*a)


def test_linearizes_once_a_step_length_about_the_initial_mean_and_leaves_old_beliefs_alone():
    model: Any = Counting(nonlinear_model(2))
    rng = np.random.default_rng(1)
    x0, cov = np.array([[0.4, 0.0], [-0.2, 0.1]]), random_cov(rng, 2, 2)
    estimator = KF(model, u0=[0.5])
    first = estimator.init(x0, cov)
    belief, t = first, 0.0
    for dt in (0.1, 0.2, 0.1 + 1e-15, 0.2, 0.1):
        u, y = rng.standard_normal((2, 1)), rng.standard_normal((2, 2))
        F = model.f_jacobian(x0, np.full((2, 1), 0.5), t, dt)
        H = model.h_jacobian(x0, np.full((2, 1), 0.5), t)
        expected = model.f(x0, u, t, dt) + np.einsum("rij,rj->ri", F, belief.mean - x0)
        P = F @ belief.cov @ np.swapaxes(F, -1, -2) + model.Q
        belief, t = estimator.predict(belief, u, t, dt), t + dt
        np.testing.assert_allclose(belief.mean, expected, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(belief.cov, P, rtol=1e-10, atol=1e-12)
        nu = y - model.h(x0, u, t) - np.einsum("rij,rj->ri", H, belief.mean - x0)
        belief, innovation = estimator.update(belief, y, u, t)
        np.testing.assert_allclose(innovation.residual, nu, rtol=1e-10, atol=1e-12)
    assert model.count == 3  # two step lengths and one set of channels
    assert not first.jacobians


def test_equals_the_ekf_at_first_and_stays_put_later_on_a_curved_state():
    model = mujoco_model("joints", "additive", 0.01)
    x, _ = random_states(model.mjmodel, 3, seed=1)
    u = np.zeros((3, model.nu))
    cov = 0.01 * random_cov(np.random.default_rng(1), model.space.n, 3)
    kf, ekf = KF(model), EKF(model)
    ours = kf.predict(kf.init(x, cov), u, 0.0, 0.008)
    theirs = ekf.predict(ekf.init(x, cov), u, 0.0, 0.008)
    np.testing.assert_allclose(ours.mean, theirs.mean, atol=1e-9)
    np.testing.assert_allclose(ours.cov, theirs.cov, atol=1e-6)
    y = model.measurement(random_states(model.mjmodel, 3, seed=2)[0], u, 0.0)
    for k in range(5):
        ours, innovation = kf.update(ours, y, u, 0.008 * (k + 1))
        assert np.isfinite(innovation.nis).all()
        ours = kf.predict(ours, u, 0.008 * (k + 1), 0.008)
    assert not ours.fault.any()
    assert (np.linalg.eigvalsh(ours.cov) > 0).all()


@pytest.mark.parametrize("seed", range(3))
def test_jacobian_of_the_tangent_map_on_curved_spaces(seed):
    model = mujoco_model("joints")
    source, target = model.space, model.output()
    rng = np.random.default_rng(seed)
    point, _ = random_states(model.mjmodel, 2, seed=seed)
    x, _ = random_states(model.mjmodel, 2, seed=seed + 10)
    image = model.measurement(point, np.zeros((2, model.nu)), 0.0)
    slope = 0.3 * rng.standard_normal((2, target.n, source.n))

    def function(points):
        p = source.minus(points, point[:, None])
        return target.plus(image[:, None], p @ np.swapaxes(slope, -1, -2))

    value, jacobian = tangent_map(source, target, x, point, image, slope)
    expected, differences = Differences("centered", 1e-5).jacobian(function, source, target, x)
    np.testing.assert_allclose(value, expected, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(jacobian, differences, atol=1e-8)


def test_an_operating_point_is_each_runs_own_so_chunks_agree():
    model = nonlinear_model(2)
    rng = np.random.default_rng(3)
    mean, cov = rng.standard_normal((5, 2)), random_cov(rng, 2, 5)
    u, estimator = np.zeros((5, 1)), KF(model)
    whole = estimator.predict(estimator.init(mean, cov), u, 0.0, 0.1)
    part = estimator.predict(estimator.init(mean[3:], cov[3:]), u[3:], 0.0, 0.1)
    np.testing.assert_allclose(whole.mean[3:], part.mean, rtol=0, atol=1e-14)


@pytest.mark.parametrize("u0", [[1.0], [1.0, float("nan")], ["a", "b"], 3.0])
def test_a_wrong_operating_control_is_refused(u0):
    with pytest.raises(EstimatorError, match=r"KF: u0 is .*use 2 finite numbers"):
        KF(linear_model(0, 3, 2, 2), u0=u0)


def test_a_time_varying_process_noise_is_asked_at_every_step():
    plain = nonlinear_model(2)

    class Varying(FunctionModel):
        def process_noise(self, x, u, t=0.0, dt=1.0):
            return (1.0 + t) * self.Q

    model = Varying(plain.f, plain.h, plain.Q, plain.R, 1)
    estimator = KF(model)
    belief = estimator.init(np.zeros((1, 2)), np.eye(2)[None])
    at = [estimator.predict(belief, np.zeros((1, 1)), t, 0.1).cov[0] for t in (0.0, 2.0)]
    np.testing.assert_allclose(at[1] - at[0], 2.0 * plain.Q, rtol=1e-10, atol=1e-12)


def test_a_robot_is_linearized_about_its_keyframes_control():
    """A quadrotor hovers at 2.45 N a rotor; about zero thrust its rates would be wrong."""
    prepared = setup.build(experiment.resolve("quadrotor", duration=0.1))
    model = prepared.model()
    np.testing.assert_array_equal(KF(model).u0, prepared.plant.u0)
    assert min(KF(model).u0) > 2.4
    assert KF(model, u0=[0.0] * 4).u0 == (0.0,) * 4
    results = experiment.run(
        "quadrotor", ["kf", "ekf"], runs=10, duration=0.5, overrides=["initial.std=0.01"]
    )
    ours, reference = ([i.value for i in results[name].rmse] for name in ("kf", "ekf"))
    np.testing.assert_allclose(ours, reference, rtol=0.1)


def test_the_linearized_filters_and_their_handover_by_settings():
    options = ["estimators.a={type='lkf'}", "estimators.b={type='lkf', handover_time=0.0}",
               "estimators.c={type='lkf', handover_sigma=2.0}"]  # fmt: skip
    labels = ["ekf", "a", "b", "c"]
    results = experiment.run("pendulum", labels, runs=10, duration=0.5, overrides=options)
    rmse = {k: [i.value for i in results[k].rmse] for k in labels}
    np.testing.assert_allclose(rmse["b"], rmse["ekf"], rtol=1e-12)
    assert rmse["a"] != rmse["ekf"]
    assert rmse["c"] not in (rmse["a"], rmse["ekf"])
