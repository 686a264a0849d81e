"""States on the constraints: against MuJoCo's own residuals, and the textbook's projection."""

import mujoco
import numpy as np
import pytest

from estbench.robots.feasible import DEEP, Feasible, has_equalities
from estbench.robots.layout import state_space
from tests.loops import LOOPS

BOXES = """<mujoco><worldbody><geom type="plane" size="2 2 .1"/>
<body pos="0 0 .1"><freejoint/><geom type="box" size=".1 .1 .1" mass="1"/></body>
</worldbody></mujoco>"""


def states(model, count, std, seed=0):
    space = state_space(model)
    x0 = np.concatenate([model.qpos0, np.zeros(model.nv)])
    errors = std * np.random.default_rng(seed).standard_normal((count, space.n))
    return space, space.plus(np.repeat(x0[None], count, axis=0), errors)


def residuals(model, x):
    """Violations and forbidden velocities of one state, by `mj_forward`."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = x[: model.nq], x[model.nq :]
    mujoco.mj_forward(model, data)
    return data.efc_pos[: data.ne].copy(), data.efc_vel[: data.ne].copy(), data


@pytest.mark.parametrize("name", LOOPS)
def test_projected_states_meet_every_equality(name):
    model = mujoco.MjModel.from_xml_string(LOOPS[name])
    assert has_equalities(model)
    space, x = states(model, 20, 0.05)
    feasible = Feasible(model, space, contacts=False)
    y = feasible.project(x)
    for state in y:
        position, velocity, _ = residuals(model, state)
        assert np.abs(position).max() < 1e-9
        assert np.abs(velocity).max() < 1e-7
    np.testing.assert_allclose(space.minus(feasible.project(y), y), 0.0, atol=1e-7)
    np.testing.assert_array_equal(feasible.project(x[3:4]), y[3:4])  # rows are independent


def test_a_linear_coupling_is_projected_in_the_metric_of_the_mass_matrix():
    model = mujoco.MjModel.from_xml_string(LOOPS["coupled"])
    space, x = states(model, 5, 0.05)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    J = np.zeros((1, model.nv))
    J[0, model.joint("right").dofadr[0]], J[0, model.joint("left").dofadr[0]] = 1.0, 1.0
    inverse = np.linalg.solve(mass, J.T)
    along = np.eye(model.nv) - inverse @ np.linalg.solve(J @ inverse, J)
    y = Feasible(model, space, contacts=False).project(x)
    np.testing.assert_allclose(y[:, : model.nq], x[:, : model.nq] @ along.T, atol=1e-9)
    np.testing.assert_allclose(y[:, model.nq :], x[:, model.nq :] @ along.T, atol=1e-7)


def test_deep_contacts_are_resolved_and_others_left():
    model = mujoco.MjModel.from_xml_string(BOXES)
    space, x = states(model, 8, 0.0)
    x[:, 2] = 0.1 - np.linspace(0.0, 0.07, 8)
    y = Feasible(model, space, contacts=True).project(x)
    np.testing.assert_array_equal(y[:2], x[:2])  # not in contact, and no deeper than 1 cm
    np.testing.assert_allclose(y[2:, 2], 0.1 - DEEP, atol=1e-6)
    np.testing.assert_array_equal(y[:, model.nq :], x[:, model.nq :])


def test_an_inactive_equality_is_none():
    text = LOOPS["coupled"].replace("<joint joint1", '<joint active="false" joint1')
    assert not has_equalities(mujoco.MjModel.from_xml_string(text))
