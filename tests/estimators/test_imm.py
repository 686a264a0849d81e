from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from estbench.errors import DimensionError, EstimatorError, ScenarioError
from estbench.estimators.beliefs import Fault
from estbench.estimators.cd_ekf import ContinuousDiscreteEKF
from estbench.estimators.ekf import EKF
from estbench.estimators.imm import IMM, combine
from estbench.estimators.ukf import UKF
from estbench.experiment import setup
from estbench.models.continuous import ContinuousFunctionModel
from estbench.models.function import FunctionModel
from estbench.models.linear import LinearModel
from estbench.montecarlo import run as experiment
from tests.estimators.test_enkf import start
from tests.helpers import linear_model, mujoco_model, nonlinear_model, random_cov, random_states

CHAIN = np.array([[0.9, 0.1], [0.3, 0.7]])


def textbook(means, covs, mu, models, u, y):
    """One cycle of one run (Bar-Shalom, Li & Kirubarajan, sec. 11.6.6), in plain matrices."""
    c = CHAIN.T @ mu
    new_means, new_covs, likelihoods = [], [], []
    for j, model in enumerate(models):
        share = CHAIN[:, j] * mu / c[j]
        x0 = sum(s * m for s, m in zip(share, means))
        P0 = sum(s * (P + np.outer(m - x0, m - x0)) for s, m, P in zip(share, means, covs))
        x = model.A @ x0 + model.B @ u
        P = model.A @ P0 @ model.A.T + model.Q
        nu = y - model.C @ x - model.D @ u
        S = model.C @ P @ model.C.T + model.R
        K = P @ model.C.T @ np.linalg.inv(S)
        new_means.append(x + K @ nu)
        new_covs.append((np.eye(len(x)) - K @ model.C) @ P)
        density = np.exp(-0.5 * nu @ np.linalg.inv(S) @ nu)
        likelihoods.append(density / np.sqrt(np.linalg.det(2 * np.pi * S)))
    mu = c * likelihoods / (c @ likelihoods)
    mean = sum(w * m for w, m in zip(mu, new_means))
    cov = sum(w * (P + np.outer(m - mean, m - mean)) for w, m, P in zip(mu, new_means, new_covs))
    return new_means, new_covs, mu, mean, cov


@pytest.mark.parametrize("seed", range(3))
def test_equals_the_textbook(seed):
    models = (linear_model(seed), linear_model(seed + 10))
    mean, cov, u = start(models[0], 3, seed)
    rng = np.random.default_rng(seed)
    imm = IMM(models[0], models=models, transition=CHAIN)
    belief = imm.init(mean, cov)
    state: list[Any] = [[[m, m], [P, P], np.array([0.5, 0.5])] for m, P in zip(mean, cov)]
    for k in range(6):
        y = rng.standard_normal((3, 2))
        belief = imm.predict(belief, u, k, 1.0)
        belief, _ = imm.update(belief, y, u, k + 1)
        for i in range(3):
            means, covs, mu = state[i]
            *modes, m, P = textbook(means, covs, mu, models, u[i], y[i])
            state[i] = modes
            np.testing.assert_allclose(belief.probability[i], state[i][2], rtol=1e-10, atol=1e-10)
            np.testing.assert_allclose(imm.mean(belief)[i], m, rtol=1e-10, atol=1e-10)
            np.testing.assert_allclose(imm.cov(belief)[i], P, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("scales", [[1.0], [1.0, 1.0, 1.0]])
@pytest.mark.parametrize("base", ["ekf", "ukf"])
def test_equal_modes_are_the_base_filter(scales, base):
    model = nonlinear_model(4)
    mean, cov, u = start(model, 3)
    imm, filter = (
        IMM(model, base=base, process_noise_scales=scales),
        {"ekf": EKF, "ukf": UKF}[base](model),
    )
    a, b = imm.init(mean, cov), filter.init(mean, cov)
    for k in range(5):
        y = model.measurement(mean, u, 0.0) + 0.1 * k
        a, b = imm.predict(a, u, k, 0.05), filter.predict(b, u, k, 0.05)
        (a, one), (b, other) = imm.update(a, y, u, k), filter.update(b, y, u, k)
        np.testing.assert_allclose(one.nis, other.nis, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(one.white, other.white, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(imm.mean(a), b.mean, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(imm.cov(a), b.cov, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(a.probability, 1 / len(scales))


def test_the_base_may_be_the_continuous_discrete_filter():
    """With Q_s scaled; both modes alike are that filter."""
    model = ContinuousFunctionModel(
        lambda x, u, t: -np.sin(x), lambda x, u, t: x[..., :1], 0.1 * np.eye(2), np.eye(1)
    )
    mean, cov, u = start(model, 3)
    imm = IMM(model, base="cd_ekf", process_noise_scales=[4.0, 4.0])
    one = ContinuousDiscreteEKF(replace(model, Q_s=0.4 * np.eye(2)))
    (a, _), (b, _) = (
        f.update(f.predict(f.init(mean, cov), u, 0.0, 0.3), np.ones((3, 1)), u, 0.3)
        for f in (imm, one)
    )
    np.testing.assert_allclose(imm.mean(a), b.mean, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(imm.cov(a), b.cov, rtol=1e-10, atol=1e-12)
    with pytest.raises(EstimatorError, match="LinearModel has no method 'flow'; use a cont"):
        IMM(linear_model(0), base="cd_ekf")


def test_a_manoeuvre_raises_the_probability_of_the_noisy_mode():
    dt = 0.1
    model = LinearModel(
        np.array([[1, dt], [0, 1]]), np.array([[1.0, 0]]),
        1e-3 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), 1e-4 * np.eye(1),
    )  # fmt: skip
    imm = IMM(model, process_noise_scales=[1, 1000], switching=0.02)
    u = np.empty((1, 0))
    belief = imm.init(np.zeros((1, 2)), 1e-4 * np.eye(2)[None])
    quiet, moving = [], []
    for k in range(100):
        t = k * dt
        position = 0.0 if t < 5 else 0.5 * (t - 5) ** 2
        belief = imm.predict(belief, u, t, dt)
        belief, _ = imm.update(belief, np.array([[position]]), u, t)
        (quiet if t < 5 else moving).append(belief.probability[0, 1])
    assert np.mean(quiet[10:]) < 0.1
    assert np.mean(moving[10:]) > 0.75


def test_models_may_have_their_process_noise_scaled_too():
    models = (linear_model(0), linear_model(1))
    mean, cov, u = start(models[0], 2)
    scaled = [replace(m, Q=q * m.Q) for m, q in zip(models, (2.0, 5.0))]
    a = IMM(models[0], models=models, process_noise_scales=[2.0, 5.0])
    b = IMM(models[0], models=scaled)
    one, other = (f.predict(f.init(mean, cov), u, 0.0, 1.0) for f in (a, b))
    np.testing.assert_allclose(a.cov(one), b.cov(other), rtol=1e-10, atol=1e-14)


def test_a_scenario_says_what_each_mode_changes_of_the_filters_model():
    """The truth has ten times the damping; one mode knows, and is soon believed."""
    results = experiment.run(
        "pendulum", ["ekf", "imm"], runs=20, duration=2.0,
        overrides=['truth.set={"dof_damping.hinge"=0.5}', "consistency.burn_in=0.5",
                   'estimators.imm={models=[{}, {"dof_damping.hinge"=0.5}]}'],
    )  # fmt: skip
    for wrong, right in zip(results["ekf"].rmse, results["imm"].rmse):
        assert right.value < 0.2 * wrong.value


@pytest.mark.parametrize(
    ("models", "message"),
    [
        ('[{"dof_damping.hing"=0.5}]', r"estimators.imm.models: 'dof_damping.hing': no dof 'hing'"),
        ("[3]", "estimators.imm.models: 3 is no table; use one like that of filter.set"),
    ],
)
def test_a_scenarios_mode_that_is_wrong(models, message):
    resolved = experiment.resolve("pendulum", overrides=[f"estimators.imm={{models={models}}}"])
    with pytest.raises(ScenarioError, match=message):
        setup.build(resolved)


def test_a_mode_that_is_never_entered_has_probability_zero_and_stays_finite():
    model = linear_model(0)
    mean, cov, u = start(model, 2)
    imm, ekf = IMM(model, transition=[[1.0, 0.0], [1.0, 0.0]]), EKF(model)
    a, b = imm.init(mean, cov), ekf.init(mean, cov)
    for k in range(3):
        a, b = imm.predict(a, u, k, 1.0), ekf.predict(b, u, k, 1.0)
        (a, _), (b, _) = imm.update(a, np.ones((2, 2)), u, k), ekf.update(b, np.ones((2, 2)), u, k)
        np.testing.assert_array_equal(a.probability, [[1.0, 0.0]] * 2)
        assert all(np.isfinite(mode.cov).all() for mode in a.beliefs)
    np.testing.assert_allclose(imm.mean(a), b.mean, rtol=1e-12)
    np.testing.assert_allclose(imm.cov(a), b.cov, rtol=1e-12)


def test_missing_component_is_out_exactly():
    model = linear_model(3)
    mean, cov, u = start(model, 3)
    imm = IMM(model, process_noise_scales=[1, 10, 100])
    belief = imm.predict(imm.init(mean, cov), u, 0.0, 1.0)
    y = model.measurement(mean, u) + 0.2
    mask = np.array([[True, False], [False, False], [True, True]])
    posterior, innovation = imm.update(belief, np.where(mask, y, np.nan), u, 0.0, mask=mask)
    np.testing.assert_array_equal(posterior.probability[1], belief.probability[1])
    np.testing.assert_array_equal(innovation.dof, [1, 0, 2])
    assert innovation.nis[1] == 0
    np.testing.assert_array_equal(imm.mean(posterior)[1], imm.mean(belief)[1])
    full, _ = imm.update(belief, y, u, 0.0)
    np.testing.assert_array_equal(imm.mean(posterior)[2], imm.mean(full)[2])
    assert model.D is not None
    part = LinearModel(model.A, model.C[:1], model.Q, model.R[:1, :1], model.B, model.D[:1])
    first, other = IMM(part, process_noise_scales=[1, 10, 100]).update(belief, y[:, :1], u, 0.0)
    np.testing.assert_allclose(
        posterior.probability[0], first.probability[0], rtol=1e-10, atol=1e-12
    )
    np.testing.assert_allclose(imm.cov(posterior)[0], imm.cov(first)[0], rtol=1e-10, atol=1e-12)
    assert np.isclose(innovation.nis[0], other.nis[0])


def test_a_failed_run_stands_alone():
    model = linear_model(5)
    mean, cov, u = start(model, 4)
    mean[1], cov[2] = np.nan, -10 * np.eye(3)
    imm = IMM(model)
    belief = imm.predict(imm.init(mean, cov), u, 0.0, 1.0)
    belief, innovation = imm.update(belief, np.ones((4, 2)), u, 1.0)
    np.testing.assert_array_equal(belief.fault, [0, Fault.STATE, Fault.INNOVATION, 0])
    for value in (imm.mean(belief), imm.cov(belief), belief.probability):
        assert np.isnan(value[1:3]).all()
        assert np.isfinite(value[[0, 3]]).all()
    assert np.isfinite(innovation.nis[[0, 3]]).all()
    again = imm.predict(belief, u, 1.0, 1.0)
    np.testing.assert_array_equal(again.fault, belief.fault)


def test_a_failed_mode_is_dropped_and_started_again():
    def breaks(x, u, t, dt):  # at t = 0 this mode has no answer in the second run
        return np.where(x[..., :1] > 5, np.nan, x) if t == 0 else x

    noise, R = 0.01 * np.eye(1), np.eye(1)
    models = [
        FunctionModel(f, lambda x, u, t: x, noise, R) for f in (lambda x, u, t, dt: x, breaks)
    ]
    imm = IMM(models[0], models=models)
    u = np.empty((2, 0))
    belief = imm.init(np.array([[0.0], [9.0]]), np.ones((2, 1, 1)))
    belief = imm.predict(belief, u, 0.0, 1.0)
    np.testing.assert_allclose(belief.probability, [[0.5, 0.5], [1.0, 0.0]])
    belief, innovation = imm.update(belief, np.array([[0.0], [9.0]]), u, 1.0)
    assert np.isfinite(innovation.nis).all()
    assert np.isfinite(imm.cov(belief)).all()
    belief = imm.predict(belief, u, 1.0, 1.0)
    np.testing.assert_allclose(belief.probability[1], [0.95, 0.05])
    assert not belief.fault.any()


def test_combine_on_a_curved_space_is_symmetric_and_exact_for_one_component():
    model = mujoco_model("joints")
    x, _ = random_states(model.mjmodel, 8)
    n = model.space.n
    rng = np.random.default_rng(0)
    means, covs = (
        x.reshape(4, 2, -1),
        np.stack([random_cov(rng, n) for _ in range(8)]).reshape(4, 2, n, n),
    )
    weight = np.tile([0.3, 0.7], (4, 1))
    mean, cov = combine(model.space, means, covs, weight)
    swapped = combine(model.space, means[:, ::-1], covs[:, ::-1], weight[:, ::-1])
    assert np.abs(model.space.minus(mean, swapped[0])).max() < 1e-10
    np.testing.assert_allclose(cov, swapped[1], rtol=1e-10, atol=1e-10)
    one = combine(
        model.space,
        means,
        np.where([[[[True]], [[False]]]], covs, np.nan),
        np.tile([1.0, 0.0], (4, 1)),
    )
    assert np.abs(model.space.minus(one[0], means[:, 0])).max() < 1e-12
    np.testing.assert_allclose(one[1], covs[:, 0], rtol=1e-10, atol=1e-10)


def test_quaternion_states():
    model = mujoco_model("joints", density=1e-3)
    x, u = random_states(model.mjmodel, 3)
    imm, n = IMM(model), model.space.n
    belief = imm.init(x, np.broadcast_to(1e-3 * np.eye(n), (3, n, n)))
    for k in range(5):
        belief = imm.predict(belief, u, 0.004 * k, 0.004)
        truth = model.transition(x, u, 0.0, 0.004 * (k + 1))
        belief, innovation = imm.update(belief, model.measurement(truth, u, 0.0), u, 0.0)
    assert not belief.fault.any()
    assert (innovation.nis < 1).all()
    assert np.abs(model.space.minus(imm.mean(belief), truth)).max() < 0.05


@pytest.mark.parametrize(
    ("settings", "error", "words"),
    [
        ({"switching": 2}, EstimatorError, "IMM: switching is 2"),
        ({"process_noise_scales": [1, -1]}, EstimatorError, "IMM: process_noise_scales is"),
        (
            {"process_noise_scales": []},
            EstimatorError,
            r"IMM: process_noise_scales is \[\]; use a list of positive",
        ),
        ({"base": "ekff"}, EstimatorError, "no estimator 'ekff'"),
        ({"settings": {"alpha": 1}}, EstimatorError, "no setting 'alpha'"),
        ({"transition": [[1.0]]}, DimensionError, r"IMM: transition has shape \(1, 1\)"),
        ({"transition": [[1, 1], [0, 1]]}, EstimatorError, "IMM: transition is"),
        ({"models": [linear_model(0, n=2)]}, EstimatorError, "state coordinates x0, x1, x2"),
        ({"models": []}, EstimatorError, "IMM: models is a list of 0; use at least one model"),
        ({"models": 3}, EstimatorError, "IMM: models is 3; use at least one model"),
        (
            {"models": [linear_model(1)], "process_noise_scales": [1.0, 2.0]},
            EstimatorError,
            r"IMM: process_noise_scales is \[1.0, 2.0\]; use .* one per mode",
        ),
    ],
)
def test_wrong_settings_say_so(settings, error, words):
    with pytest.raises(error, match=words):
        IMM(linear_model(0), **settings)
