import mujoco
import numpy as np
import pytest

from estbench.robots import contacts, mjcf
from estbench.robots.contacts import Contacts

FLOOR = '<geom name="floor" type="plane" size="5 5 .1"/>'
BALL = '<body name="ball" pos="0 0 .1"><freejoint/><geom type="sphere" size=".1"/></body>'
CRANE = """<body name="cart"><joint name="slide" type="slide" axis="1 0 0" range="-1 1"/>
<geom type="box" size=".1 .1 .1" mass="1"/><body><joint type="hinge" axis="0 1 0" range="-20 40"/>
<geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02"/>
<body pos="0 0 -.5"><joint name="ball" type="ball" range="0 60"/><geom size=".05"/></body></body>
</body>"""


def spec(*parts, extra=""):
    return mujoco.MjSpec.from_string(
        f"<mujoco><worldbody>{''.join(parts)}</worldbody>{extra}</mujoco>"
    )


def touches(robot, x, slip=0.05, varied=()):
    chosen = contacts.colliding(robot.copy().compile())
    model = mjcf.compile_model(contacts.sensed(robot, chosen))
    return Contacts.of(model).look(np.asarray(x, float), slip, varied)


def free(z, velocity=(0, 0, 0)):
    return [0, 0, z, 1, 0, 0, 0, *velocity, 0, 0, 0]


def test_a_ball_touches_the_floor_below_its_radius_and_slips_with_its_tangential_speed():
    fast, slow, falls = (0.04, 0.04, 0), (0.03, 0.03, 0), (0, 0, -1)
    x = [[free(0.11, fast), free(0.099, slow)], [free(0.099, fast), free(0.099, falls)]]
    found = touches(spec(FLOOR, BALL), x)
    np.testing.assert_array_equal(found.touching[..., 0], [[False, True], [True, True]])
    np.testing.assert_array_equal(found.slipping[..., 0], [[False, False], [True, False]])
    assert found.limited.shape == (2, 2, 0)


def test_the_slip_is_relative_to_a_body_that_moves_along():
    other = '<body name="sled"><freejoint/><geom type="box" size="1 1 .1"/></body>'
    robot = spec(BALL.replace('pos="0 0 .1"', ""), other)
    moving = np.array([*free(0.199)[:7], *free(0)[:7], *free(0, (1, 0, 0))[7:] * 2])
    still = np.array([*free(0.199)[:7], *free(0)[:7], *free(0, (1, 0, 0))[7:], *[0] * 6])
    found = touches(robot, [[moving, still]])
    assert found.touching.all()
    np.testing.assert_array_equal(found.slipping[0], [[False, False], [True, True]])


def test_limits_are_those_of_mujoco_and_only_bodies_that_may_touch_are_watched():
    robot = spec(CRANE)
    model = robot.copy().compile()
    rng = np.random.default_rng(0)
    q = rng.uniform(-1.2, 1.2, (40, 2)) * [1.0, 0.6]
    angle = rng.uniform(0.5, 1.5, 40)
    quat = np.stack([np.cos(angle / 2), np.sin(angle / 2), 0 * angle, 0 * angle], axis=1)
    x = np.concatenate([q, quat, np.zeros((40, 5))], axis=1)
    found = touches(robot, x[None])
    wanted = [abs(q[:, 0]) > 1, (q[:, 1] < np.radians(-20)) | (q[:, 1] > np.radians(40)),
              angle > np.radians(60)]  # fmt: skip
    np.testing.assert_array_equal(found.limited[0], np.array(wanted).T)
    assert found.limited.any(axis=(0, 1)).all()
    # The arm is the child of the cart and the parent of the tip.
    np.testing.assert_array_equal(contacts.colliding(model), [False, True, False, True])
    assert found.touching.shape == (1, 40, 2)


@pytest.mark.parametrize(
    ("floor", "extra", "may"),
    [
        (FLOOR, "", True),
        (FLOOR.replace("/>", ' contype="0" conaffinity="2"/>'), "", False),
        (FLOOR.replace("/>", ' contype="2" conaffinity="1"/>'), "", True),
        (FLOOR, '<contact><exclude body1="ball" body2="world"/></contact>', False),
        (FLOOR.replace("/>", ' contype="0" conaffinity="0"/>'),
         '<contact><pair geom1="floor" geom2="g"/></contact>', True),
        (FLOOR, '<option><flag contact="disable"/></option>', False),
        ("", "", False),
    ],
)  # fmt: skip
def test_which_bodies_may_touch_something(floor, extra, may):
    robot = spec(floor, BALL.replace("<geom ", '<geom name="g" '), extra=extra)
    model = robot.copy().compile()
    assert contacts.colliding(model).tolist() == [False, may]
    if may:
        assert touches(robot, [[free(0.05)]]).touching.all()
    data = mujoco.MjData(model)
    data.qpos[2] = 0.05
    mujoco.mj_forward(model, data)
    assert (data.ncon > 0) == may


def test_a_parameter_that_differs_between_the_runs_counts():
    x = [[free(0.15)] * 3]
    index = 1
    sizes = np.array([[0.1, 0, 0], [0.2, 0, 0], [0.1, 0, 0]])
    found = touches(spec(FLOOR, BALL), x, varied=[("geom_size", index, sizes)])
    np.testing.assert_array_equal(found.touching[0, :, 0], [False, True, False])


def test_a_state_that_failed_touches_nothing():
    found = touches(spec(FLOOR, BALL), [[free(0.05), free(np.nan)], [free(np.nan), free(0.05)]])
    np.testing.assert_array_equal(found.touching[..., 0], [[True, False], [False, True]])
