"""The MuJoCo model in continuous time: its flow, its noise, and the filter that integrates both."""

import mujoco
import numpy as np
import pytest

from estbench.estimators.cd_ekf import ContinuousDiscreteEKF
from estbench.estimators.ekf import EKF
from estbench.experiment import setup
from estbench.models.continuous import ContinuousModel, integrate_moments
from estbench.montecarlo import run as experiment
from estbench.robots.controls import ControlRange
from estbench.robots.disturbance import Disturbance
from estbench.robots.layout import state_space
from estbench.robots.model import MujocoModel
from tests.helpers import CENTERED, ZOO, all_channels, mujoco_model, random_states, zoo_model


def split(model, x):
    """qpos, qvel, act of one state."""
    return np.split(x, [model.nq, model.nq + model.nv])


def rate(model, x, u, force=0.0):
    """(q̇, q̈, ȧ) of one state by MuJoCo itself."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.act[:] = split(model, x)
    data.ctrl[:], data.qfrc_applied[:] = u, force
    mujoco.mj_forward(model, data)
    return np.concatenate([data.qvel, data.qacc, data.act_dot])


@pytest.mark.parametrize("name", ZOO)
def test_the_flow_is_mujocos_forward_dynamics_and_leaves_no_trace(name):
    model, raw = mujoco_model(name), zoo_model(name)
    x, u = random_states(raw, 3)
    after = model.transition(x, u, 0.0, raw.opt.timestep)
    u_clamped = ControlRange.of(raw).clamp(u)
    expected = [rate(raw, a, b) for a, b in zip(x, u_clamped)]
    np.testing.assert_array_equal(model.flow(x, u, 0.0), expected)
    points = np.repeat(x[:, None], 2, axis=1)
    np.testing.assert_array_equal(model.flow(points, u, 0.0)[:, 1], expected)
    np.testing.assert_array_equal(model.transition(x, u, 0.0, raw.opt.timestep), after)
    assert isinstance(model, ContinuousModel)


def test_a_row_that_is_not_finite_has_no_flow():
    model = mujoco_model("joints")
    x, u = random_states(zoo_model("joints"), 3)
    x[1, 0] = np.nan
    flow = model.flow(x, u, 0.0)
    assert np.isnan(flow[1]).all()
    assert np.isfinite(flow[[0, 2]]).all()


@pytest.mark.parametrize("name", ["joints", "activations", "free"])
def test_the_flow_jacobian_is_that_of_the_flow(name):
    model, raw = mujoco_model(name, differences=CENTERED), zoo_model(name)
    x, u = random_states(raw, 2)
    value, F = model.flow_jacobian(x, u, 0.0)
    n, nv = model.space.n, raw.nv
    np.testing.assert_array_equal(value, model.flow(x, u, 0.0))
    np.testing.assert_allclose(F[:, :nv, nv : 2 * nv], np.tile(np.eye(nv), (2, 1, 1)), atol=1e-8)
    direction = np.random.default_rng(0).standard_normal(n)
    h = 1e-5
    ahead, behind = (model.flow(model.space.plus(x, s * h * direction), u, 0.0) for s in (1, -1))
    np.testing.assert_allclose(F @ direction, (ahead - behind) / (2 * h), atol=1e-5)


@pytest.mark.parametrize("name", ["joints", "activations", "free"])
def test_a_forces_density_enters_through_the_inverse_of_the_mass_matrix(name):
    raw = zoo_model(name)
    space, nv = state_space(raw), raw.nv
    root = np.random.default_rng(1).standard_normal((nv, nv))
    Q_s = root @ root.T
    noise = Disturbance.build(raw, space, "force", matrix=Q_s.tolist())
    model = MujocoModel(raw, all_channels(raw), noise)
    x, u = random_states(raw, 2)
    for state, density in zip(x, model.spectral_density(x, u, 0.0)):
        data, M = mujoco.MjData(raw), np.zeros((nv, nv))
        data.qpos[:], data.qvel[:], data.act[:] = split(raw, state)
        mujoco.mj_forward(raw, data)
        mujoco.mj_fullM(raw, data, M)
        inverse = np.linalg.inv(M)
        expected = np.zeros_like(density)
        expected[nv : 2 * nv, nv : 2 * nv] = inverse @ Q_s @ inverse
        scale = np.abs(expected).max()
        np.testing.assert_allclose(density, expected, atol=1e-8 * scale)


def test_an_actuators_density_enters_through_its_gain_or_its_activation():
    raw = zoo_model("activations")
    model = mujoco_model("activations", "actuator", {"lag": 0.3, "direct": 0.1})
    x, u = random_states(raw, 1)
    density = model.spectral_density(x, u, 0.0)[0]
    act = 2 * raw.nv
    assert density[act, act] == pytest.approx(0.3 / 0.2**2)  # ȧ = (u - a)/0.2
    slope = rate(raw, x[0], u[0] + [0, 0, 1]) - rate(raw, x[0], u[0])
    both = np.ix_(range(raw.nv, act), range(raw.nv, act))
    expected = 0.1 * np.outer(slope, slope)
    np.testing.assert_allclose(density[both], expected[both], rtol=1e-8)


def test_an_additive_density_is_its_own_and_follows_the_schedule():
    model = mujoco_model("joints", "additive", {"lift.vel": 0.2})
    x, u = random_states(zoo_model("joints"), 2)
    Q_s = model.spectral_density(x, u, 0.0)
    assert np.diag(Q_s)[model.space.index("lift.vel")] == 0.2
    assert Q_s.sum() == 0.2
    assert not mujoco_model("joints", "force").spectral_density(x, u, 0.0).any()


def start(robot, timestep, integrator="Euler", kind=None):
    """A robot with its noise, and the prior of two runs."""
    overrides = [f"model.timestep={timestep}", f"model.integrator={integrator}"]
    if kind is not None:
        overrides.append(f'process_noise={{kind="{kind}", density=0.01}}')
    prepared = setup.build(experiment.resolve(robot, overrides=overrides))
    away = 0.1 * np.random.default_rng(0).standard_normal((2, prepared.space.n))
    return prepared, prepared.space.plus(prepared.mean, away), np.tile(prepared.cov, (2, 1, 1))


def driven(estimator, prepared, mean, cov, step):
    """The belief after 0.1 s and a measurement every 0.05 s."""
    belief = estimator.init(mean, cov)
    u = np.tile(prepared.plant.u0, (len(mean), 1))
    count = round(0.05 / step)
    for half in range(2):
        for k in range(count):
            belief = estimator.predict(belief, u, 0.05 * half + k * step, step)
        y = estimator.model.measurement(mean, u, 0.05 * (half + 1))
        belief, _ = estimator.update(belief, y, u, 0.05 * (half + 1))
    return belief


@pytest.mark.parametrize(
    ("robot", "kind"),
    [("pendulum", None), ("acrobot", "force"), ("cartpole", "actuator"), ("quadrotor", None)],
)
def test_the_discrete_ekf_converges_to_it_with_the_order_of_its_integrator(robot, kind):
    """Euler and noise once per step are of order one: half the timestep, half the distance."""
    distance = []
    for step in (0.005, 0.0025, 0.00125):
        prepared, mean, cov = start(robot, step, kind=kind)
        ekf = driven(EKF(prepared.model()), prepared, mean, cov, step)
        cd = driven(ContinuousDiscreteEKF(prepared.model()), prepared, mean, cov, step)
        scale = np.sqrt(np.diagonal(cd.cov, axis1=1, axis2=2))
        apart = prepared.space.minus(ekf.mean, cd.mean) / scale
        spread = (ekf.cov - cd.cov) / (scale[:, :, None] * scale[:, None, :])
        distance.append([np.abs(apart).max(), np.abs(spread).max()])
    order = np.log2(np.array(distance)[:-1] / np.array(distance)[1:])
    assert (np.abs(order[-1] - 1.0) < 0.12).all(), order


def test_its_own_integration_is_of_order_four():
    """Of state and Φ, against MuJoCo's own RK4 with a step thirty times as small as the finest."""
    fine, mean, _ = start("acrobot", 4e-4, "RK4")
    u = np.zeros((2, 1))
    model = fine.model()
    model.differences = CENTERED
    end, Phi = model.transition_jacobian(mean, u, 0.0, 0.05)
    errors = []
    for substeps in (1, 2, 4):
        ours, our_Phi, _ = integrate_moments(model, mean, u, 0.0, 0.05, substeps)
        errors.append([np.abs(ours - end).max(), np.abs(our_Phi - Phi).max()])
    order = np.log2(np.array(errors)[:-1] / np.array(errors)[1:])
    assert (order > 3.6).all(), (order, errors)


def test_on_a_finely_stepped_robot_it_is_as_consistent_as_the_discrete_filter():
    """On a coarse one the integrator's error is a model error that it does not know of."""
    fine = ["model.timestep=0.001", "model.frame_skip=10"]
    results = experiment.run("pendulum", ["ekf", "cd_ekf"], runs=20, duration=1.0, overrides=fine)
    ours, other = results["cd_ekf"], results["ekf"]
    assert ours.anees.value == pytest.approx(other.anees.value, rel=0.1)
    np.testing.assert_allclose(
        [i.value for i in ours.rmse], [i.value for i in other.rmse], rtol=0.05
    )
