"""Coordinates with a column of Φ that is that of the identity, and what makes them others."""

import mujoco
import numpy as np
import pytest

from estbench.experiment.setup import build
from estbench.robots.ignorable import ignorable
from estbench.scenario.load import resolve

ROBOT = """<mujoco><option timestep="0.01"/>
  <worldbody>{world}
    <body name="cart" {pose}><joint name="x" type="slide" axis="1 0 0" {x}/>
      <joint name="z" type="slide" axis="0 0 1"/><geom size="0.1"/>
      <body pos="0 0 0.3"><joint name="arm" axis="0 1 0"/><geom size="0.1"/></body></body>
    {more}
  </worldbody>{end}</mujoco>"""
FLOOR = '<geom type="plane" size="5 5 1"/>'


def found(world=FLOOR, pose="", x="", more="", end=""):
    text = ROBOT.format(world=world, pose=pose, x=x, more=more, end=end)
    return ignorable(mujoco.MjModel.from_xml_string(text)).tolist()


def actuator(kind):
    return f"<actuator>{kind}</actuator>"


@pytest.mark.parametrize(
    ("expected", "robot"),
    [
        ([0], {}),  # along the floor
        ([0, 1], {"world": ""}),
        ([0, 1], {"world": '<geom type="plane" size="5 5 1" contype="0" conaffinity="0"/>'}),
        ([1], {"pose": 'euler="0 90 0"'}),  # z is now along the floor
        ([], {"world": '<geom type="plane" size="5 5 1" euler="0 5 0"/>'}),
        ([], {"world": '<geom type="box" size="5 5 1" pos="0 0 -3"/>'}),
        ([], {"x": 'limited="true" range="-1 1"'}),
        ([], {"x": 'stiffness="1"'}),
        ([0], {"x": 'damping="1" frictionloss="0.1" armature="0.1"'}),
        ([0], {"end": actuator('<motor joint="x"/>')}),
        ([], {"end": actuator('<position joint="x" kp="3"/>')}),
        ([0], {"end": actuator('<velocity joint="arm" kv="3"/>')}),
        ([], {"end": actuator('<adhesion body="cart" ctrlrange="0 1"/>')}),
        ([], {"more": '<body><freejoint/><geom size="0.1"/></body>'}),  # another robot
        ([], {"more": '<body mocap="true"><geom size="0.1"/></body>'}),
        ([], {"end": '<equality><joint joint1="x" joint2="z"/></equality>'}),
        ([], {"end": '<tendon><fixed><joint joint="x" coef="1"/></fixed></tendon>'}),
    ],
)
def test_what_a_motion_does_not_depend_on(expected, robot):
    assert found(**robot) == expected


@pytest.mark.parametrize(
    ("robot", "expected"),
    [("cartpole", (0,)), ("quadrotor", (0, 1, 2)), ("biped", (0, 1)), ("pendulum", ())],
)
def test_the_columns_are_those_of_differences(robot, expected):
    made = build(resolve(robot))
    model, space, rng = made.model(), made.space, np.random.default_rng(0)
    x = np.repeat(made.plant.x0[None], 3, axis=0)
    x = space.plus(x, 0.1 * rng.standard_normal((3, space.n)))
    u = np.repeat(made.plant.u0[None], 3, axis=0)
    mean, F = model.transition_jacobian(x, u, 0.0, made.plant.period)
    assert tuple(ignorable(made.plant.model)) == expected
    end, slope = model.differences.jacobian(
        lambda points: model.transition(points, u, 0.0, made.plant.period), space, space, x
    )
    np.testing.assert_array_equal(mean, end)
    np.testing.assert_allclose(F, slope, atol=1e-7)
    np.testing.assert_array_equal(F[..., expected], np.eye(space.n)[None, :, expected].repeat(3, 0))
