"""Errors at the start of a filter in an environment lie along its equality constraints."""

import mujoco
import numpy as np
import pytest

from estbench.envs.prior import Prior
from estbench.robots import given
from estbench.robots.held import held

WELDED = """
<mujoco><option timestep="0.002"/>
  <worldbody>
    <body name="hand" mocap="true" pos="0.9 0 0"/>
    <body><joint name="base" type="slide" axis="1 0 0" damping="1e11"/><geom size="0.1" mass="10"/>
      <body><joint name="shoulder" axis="0 1 0"/><geom size="0.05" pos="0.5 0 0" mass="1"/>
        <body name="wrist" pos="1 0 0"><joint name="elbow" axis="0 1 0"/>
          <geom size="0.05" mass="0.5"/></body></body></body>
  </worldbody>
  <equality><connect body1="hand" body2="wrist" anchor="0 0 0" solref="0.02 1"/></equality>
</mujoco>"""


def test_only_the_changes_that_keep_the_constraints_are_left():
    model = mujoco.MjModel.from_xml_string(WELDED)
    data = mujoco.MjData(model)
    data.mocap_pos[0, 0] = 0.7  # the weld is far from met: the mocap body has moved
    x, u = np.zeros((1, 6)), np.empty((1, given.size(model)))
    x[0, 1] = 0.3
    mujoco.mj_getState(model, data, u[0], given.INPUTS)
    std = np.array([0.0, 0.2, 0.3, 0.0, 0.5, 0.6])
    white = np.random.default_rng(0).standard_normal((1, 6))
    error, cov = Prior(model, std).errors(x, u, white)
    data.qpos[:] = x[0, :3]
    mujoco.mj_fwdPosition(model, data)
    J = data.efc_J.reshape(-1, 3)[:, 1:]  # the base is held: it takes no part
    assert np.abs(J @ error[0, 1:3]).max() < 1e-12
    assert np.abs(J @ error[0, 4:]).max() < 1e-12
    np.testing.assert_allclose(error[0, [0, 3]], [0.0, 0.0], atol=1e-7)
    M = np.empty((3, 3))
    mujoco.mj_fullM(model, data, M)
    W = np.linalg.inv(M[1:, 1:])
    along = np.eye(2) - W @ J.T @ np.linalg.pinv(J @ W @ J.T) @ J
    for part, spread in ((slice(1, 3), std[1:3]), (slice(4, 6), std[4:])):
        expected = along @ np.diag(spread**2) @ along.T
        np.testing.assert_allclose(cov[0, part, part], expected, atol=1e-7)


def test_a_robot_without_constraints_has_the_errors_as_they_are():
    model = mujoco.MjModel.from_xml_string(WELDED.replace("<equality>", "<equality><!--").replace(
        "</equality>", "--></equality>"))  # fmt: skip
    white, std = np.ones((2, 6)), np.arange(6.0)
    error, cov = Prior(model, std).errors(np.zeros((2, 6)), np.zeros((2, 1)), white)
    np.testing.assert_array_equal(error, np.tile(std, (2, 1)))
    np.testing.assert_array_equal(cov[1], np.diag(std**2))


@pytest.mark.parametrize(("damping", "holds"), [("1e11", True), ("1e5", False), ("0", False)])
def test_a_base_that_its_damping_holds(damping, holds):
    text = WELDED.replace('damping="1e11"', f'damping="{damping}"')
    np.testing.assert_array_equal(held(mujoco.MjModel.from_xml_string(text)), [holds, False, False])
