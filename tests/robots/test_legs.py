import re

import mujoco
import numpy as np
import pytest

from estbench.errors import ScenarioError
from estbench.experiment import setup
from estbench.models.legged import LeggedModel
from estbench.montecarlo import run as experiment
from tests.legged import robot, xml


def differences(legs, q, step=1e-6):
    moves = step * np.eye(q.shape[-1])
    ends = [[legs.feet(q + sign * move)[0] for sign in (1, -1)] for move in moves]
    return np.stack([(up - down) / (2 * step) for up, down in ends], axis=-1)


@pytest.mark.parametrize(("name", "radius"), [("quadruped", 0.022), ("biped", 0.0)])
def test_the_feet_of_the_bundled_robots(name, radius):
    prepared = setup.build(experiment.resolve(name))
    model = prepared.model()
    assert isinstance(model, LeggedModel)
    legs, rng = model.legs, np.random.default_rng(1)
    q = prepared.mean[legs.joints[:, 0]] + 0.3 * rng.standard_normal((3, len(legs.joints)))
    s, J, turns = legs.feet(q)
    np.testing.assert_allclose(J, differences(legs, q), atol=1e-8)
    robot, data = model.mjmodel, mujoco.MjData(model.mjmodel)
    data.qpos[:7], data.qpos[legs.joints[:, 0]] = [0, 0, 0, 1, 0, 0, 0], q[0]
    mujoco.mj_fwdPosition(robot, data)
    jacobian = np.zeros((3, robot.nv))
    for foot, touch in enumerate(legs.touches):
        mujoco.mj_jacSite(robot, data, None, jacobian, robot.sensor(touch).objid[0])
        expected = legs.axes.T @ jacobian[:, legs.joints[:, 1]]
        np.testing.assert_allclose(turns[0, foot], expected, atol=1e-12)
    np.testing.assert_array_equal(legs.radii, np.full(len(legs.touches), radius))
    # One run alone has the same feet, whatever its batch.
    np.testing.assert_array_equal(legs.feet(q[1:2])[0], s[1:2])
    # At rest the soles, or the lowest points of the feet, are on the floor: one height for all.
    rest, *_ = legs.feet(prepared.mean[None, legs.joints[:, 0]])
    np.testing.assert_allclose(np.ptp(rest[0, :, 2]), 0.0, atol=2e-3)
    assert legs.moves.sum(axis=1).tolist() == [len(legs.joints) // len(s[0])] * len(s[0])


def test_feet_are_seen_from_the_imu():
    """In axes turned by 90° about z: x of the IMU is y of the base."""
    half = np.sqrt(0.5)
    legs = robot(xml("0.05 0 0.02", f"{half} 0 0 {half}")).legs
    q = np.array([[0.01, 0.02, 0.03, 0.0, 0.0, 0.0]])
    s, J, _ = legs.feet(q)
    foot = np.array([0.2 + 0.01, 0.1 + 0.02, -0.4 + 0.03]) - [0.05, 0.0, 0.02]
    np.testing.assert_allclose(s[0, 0], [foot[1], -foot[0], foot[2]], atol=1e-12)
    np.testing.assert_allclose(J, differences(legs, q), atol=1e-8)
    np.testing.assert_allclose(legs.axes @ s[0, 0] + legs.offset, [0.21, 0.12, -0.37], atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('<gyro name="gyro" site="imu"/>', ""), "the channels none are of type gyro; one is"),
        (('<touch name="a_touch" site="a_foot"/>', '<gyro name="b_gyro" site="imu"/>'), "gyro, b_"),
        (('<jointpos name="b_y_encoder" joint="b_y"/>', ""), "no encoder on b_y; add a jointpos"),
        (('name="accelerometer" site="imu"', 'name="accelerometer" site="a_foot"'), "not at one"),
        (('<freejoint name="root"/>', '<joint name="root" type="ball"/>'), "a free joint; put"),
    ],
)
def test_a_robot_that_such_a_filter_cannot_use(change, message):
    text = xml().replace(*change)
    assert text != xml()
    with pytest.raises(ScenarioError, match=re.escape(message)):
        _ = robot(text).legs
