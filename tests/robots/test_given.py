"""All inputs of a robot as u: mocap poses, forces, switched constraints, and the model's number."""

import copy

import mujoco
import numpy as np
import pytest

from estbench import open_results, run
from estbench.robots import batch, fields, flags, given
from estbench.robots.disturbance import Disturbance
from estbench.robots.layout import state_space
from estbench.robots.model import MujocoModel
from tests.envs.changing import ARM


def arm():
    model = mujoco.MjModel.from_xml_string(ARM)
    flags.set_flags(model)
    return model


def reference(model, x, inputs, nstep):
    """The state after some steps of plain MuJoCo."""
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, inputs, given.INPUTS)
    data.qpos[:], data.qvel[:] = x[: model.nq], x[model.nq :]
    mujoco.mj_step(model, data, nstep)
    return np.concatenate([data.qpos, data.qvel])


def drawn(model, rows, seed=0):
    rng = np.random.default_rng(seed)
    u = np.tile(given.at_rest(model), (rows, 1))
    columns = given.columns(model)
    for name in ("controls", "qfrc_applied", "xfrc_applied"):
        u[:, columns[name]] = rng.normal(0, 0.3, u[:, columns[name]].shape)
    u[:, columns["mocap_pos"]] += rng.normal(0, 0.1, (rows, 3))
    u[::2, columns["eq_active"]] = 0
    return rng.normal(0, 0.3, (rows, model.nq + model.nv)), u


def test_steps_are_those_of_mujoco_under_all_inputs_and_of_the_numbered_model():
    model = arm()
    other = fields.given(model, {"body_mass": 3 * model.body_mass, "opt.gravity": np.ones(3)})
    backend = batch.BatchBackend(model)
    backend.follow(7, other)
    x, inputs = drawn(model, 4)
    numbers = np.array([0.0, 7.0, 7.0, 0.0])
    u = np.c_[inputs, numbers]
    wanted = [reference((model, other)[int(n > 0)], *row, 5) for *row, n in zip(x, inputs, numbers)]
    np.testing.assert_array_equal(backend.step(x, u, 0.0, 5), wanted)
    points = np.repeat(x[:, None], 3, axis=1)
    for k in range(3):
        np.testing.assert_array_equal(backend.step(points, u, 0.0, 5)[:, k], wanted)
    np.testing.assert_array_equal(copy.deepcopy(backend).step(x, u, 0.0, 5), wanted)
    one = np.array([[0.0, 0.4, 0.0]])
    force = inputs.copy()
    force[:, given.columns(model)["qfrc_applied"]] += one
    np.testing.assert_array_equal(
        backend.step(x, u, 0.0, 5, one), backend.step(x, np.c_[force, numbers], 0.0, 5)
    )
    plain = np.c_[np.tile(given.at_rest(model), (4, 1)), np.zeros(4)]
    np.testing.assert_array_equal(
        backend.step(x, np.zeros((4, 1)), 0.0, 5), backend.step(x, plain, 0.0, 5)
    )
    backend.follow(7, None)
    with pytest.raises(KeyError):
        backend.step(np.repeat(x, 2, axis=0), np.repeat(u, 2, axis=0), 0.0, 5)


def test_noise_on_the_controls_is_added_to_the_controls_of_all_inputs():
    model = arm()
    made = [
        MujocoModel(model, (), Disturbance.build(model, state_space(model), "actuator", 0.5))
        for _ in range(2)
    ]
    x, u = drawn(model, 2)
    rest = np.c_[np.tile(given.at_rest(model), (2, 1)), np.zeros(2)]
    rest[:, 0] = u[:, 0] = [0.1, 0.2]
    narrow = made[0].process_noise(x, rest[:, :1], 0.0, 0.02)
    np.testing.assert_allclose(made[1].process_noise(x, rest, 0.0, 0.02), narrow, rtol=1e-9)
    assert np.abs(made[1].process_noise(x, np.c_[u, [0, 0]], 0.0, 0.02) - narrow).max() > 1e-9


def test_mocap_bodies_of_a_scenario_stay_where_its_keyframe_puts_them(tmp_path):
    keyframes = """<keyframe><key name="home" qpos="0.6 -1.2 0" mpos="0.5 0 0.2"/>
      <key name="up" qpos="0.6 -1.2 0" mpos="0.3 0 0.4"/></keyframe></mujoco>"""
    (tmp_path / "arm.xml").write_text(ARM.replace("</mujoco>", keyframes))
    (tmp_path / "arm.toml").write_text(
        'name = "arm"\n[model]\npath = "arm.xml"\nkeyframe = "up"\n[initial]\nstd = 0.0\n'
        "[process_noise]\ndensity = 0.0\n[simulation]\nruns = 1\nduration = 0.4\n"
    )
    result = run(tmp_path / "arm.toml", ["ekf"], out=tmp_path / "store")
    truth = open_results(tmp_path / "store")["truth/x"].values[0]
    inputs, model = given.at_rest(arm()), arm()
    inputs[given.columns(model)["mocap_pos"]] = [0.3, 0, 0.4]
    end = reference(model, truth[0], inputs, len(truth) - 1)
    np.testing.assert_allclose(truth[-1], end, atol=1e-9)
    assert any(
        "mocap bodies (hand) stay where keyframe 'up' puts them" in n for n in result.notices
    )
