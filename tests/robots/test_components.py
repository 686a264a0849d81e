"""What the state holds of a reading is what MuJoCo computes."""

import mujoco
import numpy as np
import pytest

from estbench.models.differences import Differences
from estbench.robots import backend, mjcf
from estbench.robots.components import components
from estbench.robots.layout import sensor_space, state_space
from estbench.robots.library import engine
from estbench.robots.measurement import needed_stage, sensor_columns
from tests.helpers import random_states

ROBOT = """
<mujoco>
  <worldbody>
    <body name="base" pos="0 0 1" quat="0.8 0.6 0 0">
      <freejoint name="root"/><geom size="0.1 0.2 0.3" type="box" pos="0.1 0 0"/>
      <site name="middle"/><site name="aside" pos="0.1 0 0"/><site name="turned" quat="0 1 0 0"/>
      <body name="arm" pos="0.2 0 0">
        <joint name="shoulder" type="ball"/><geom size="0.05" pos="0.2 0.1 0"/>
        <site name="wrist"/>
        <body pos="0.3 0 0"><joint name="elbow" axis="0 1 0"/><geom size="0.05"/></body>
      </body>
    </body>
  </worldbody>
  <sensor>%s</sensor>
</mujoco>
"""
HELD = (
    '<ballquat joint="shoulder"/>', '<ballangvel joint="shoulder"/>', '<jointpos joint="elbow"/>',
    '<jointvel joint="elbow"/>', '<framepos objtype="xbody" objname="base"/>',
    '<framequat objtype="site" objname="middle"/>', '<gyro site="middle"/>',
    '<framelinvel objtype="xbody" objname="base"/>',
)  # fmt: skip


def compiled(*sensors):
    return mjcf.compile_model(mujoco.MjSpec.from_string(ROBOT % "".join(sensors)))


def test_readings_and_jacobian_are_those_of_mujoco():
    model = compiled(*HELD)
    sensors = tuple(range(model.nsensor))
    columns, stage = sensor_columns(model, sensors), needed_stage(model, sensors)
    found = components(model, sensors, columns)
    assert found is not None
    x, u = random_states(model, 4, scale=1.0)
    rows = backend.create(model)
    with engine():
        y, H = Differences("centered").jacobian(
            lambda points: rows.read(points, u, 0.0, stage, columns),
            state_space(model), sensor_space(model, sensors), x,
        )  # fmt: skip
    np.testing.assert_allclose(x[:, found[0]], y, atol=1e-14)
    np.testing.assert_allclose(np.broadcast_to(found[1], H.shape), H, atol=1e-8)


def test_some_axes_in_another_order():
    model = compiled('<gyro site="middle"/>')
    point, H = components(model, [0], np.array([2, 0])) or pytest.fail("it is in the state")
    nv = model.nv
    np.testing.assert_array_equal(point, [model.nq + 5, model.nq + 3])
    np.testing.assert_array_equal(H, np.eye(2 * nv)[[nv + 5, nv + 3]])


@pytest.mark.parametrize(
    "sensor",
    [
        '<gyro site="turned"/>',
        '<framepos objtype="site" objname="aside"/>',
        '<framepos objtype="body" objname="base"/>',  # the centre of mass
        '<framequat objtype="xbody" objname="arm"/>',
        '<framepos objtype="xbody" objname="base" reftype="site" refname="wrist"/>',
        '<frameangvel objtype="xbody" objname="base"/>',
        '<velocimeter site="middle"/>',
        '<gyro site="middle" cutoff="1"/>',
    ],
)
def test_what_the_state_does_not_hold(sensor):
    model = compiled(HELD[2], sensor)
    assert components(model, [1], sensor_columns(model, [1])) is None
    assert components(model, [0, 1], sensor_columns(model, [0, 1])) is None
