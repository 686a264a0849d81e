"""Which sensors a robot has: the rule for robots without any, and entries for many objects."""

import mujoco
import pytest

from estbench.envs import sensors
from estbench.errors import ScenarioError
from estbench.experiment.setup import build
from estbench.robots.added_sensors import object_names
from estbench.scenario.schema import Scenario

# joint3 is the name of joint 2, so that joint 3, without a name, needs another.
ROBOT = """<mujoco><worldbody>
  <body><freejoint/><geom size=".1"/><site/>
    <body><joint type="hinge"/><geom size=".1" pos="0 0 .3"/></body>
    <body><joint type="slide" axis="1 0 0" name="joint3"/><geom size=".1" pos="0 0 -.3"/></body>
  </body>
  <body pos="1 0 0"><joint type="ball"/><geom size=".1" pos="0 0 -.3"/></body>
</worldbody></mujoco>"""
USUAL = [
    "joint1_encoder", "joint3_encoder", "joint3__encoder",
    "body1_position", "body1_attitude", "body1_gyro",
]  # fmt: skip


@pytest.fixture
def made(tmp_path):
    (tmp_path / "robot.xml").write_text(ROBOT, encoding="utf-8")
    model = {"path": str(tmp_path / "robot.xml")}

    def of(**sections):
        data = {"name": "r", "model": model, "estimators": {"ekf": {}}, **sections}
        return build(Scenario.model_validate(data))

    return of


def names(setup):
    return [channel.name for channel in setup.channels]


def test_objects_without_a_name_get_one_that_is_free():
    model = mujoco.MjModel.from_xml_string(ROBOT)
    assert object_names(model, "joint") == ["joint0", "joint1", "joint3", "joint3_"]
    assert object_names(model, "body")[:2] == ["world", "body1"]
    assert object_names(model, "site") == ["site0"]


def test_a_robot_without_sensors_gets_encoders_pose_and_gyro(made):
    setup = made()
    assert names(setup) == USUAL
    said = [line for line in setup.notices if "sensor" in line]
    assert said == [
        "no sensor declared; using 2 joint encoders (0.01 rad), joint3_encoder (0.01 m), "
        "body1_position (0.01 m), body1_attitude (0.01 rad), body1_gyro (0.02 rad/s) "
        "(sensors = [] for none)"
    ]
    again = build(Scenario.model_validate(setup.scenario.model_dump(exclude_none=True)))
    assert names(again) == USUAL  # what a store keeps


def test_a_section_changes_a_sensor_of_the_rule(made):
    setup = made(channels={"joint1_encoder": {"noise": 0.5, "rate": 50.0}})
    assert names(setup) == USUAL
    assert setup.channels[0].cov == pytest.approx(0.25)
    assert setup.channels[0].timing.rate == pytest.approx(50.0)


def test_the_rule_is_off(made):
    with pytest.raises(ScenarioError, match="no sensor: "):
        made(sensors=[])
    only = made(channels={"w": {"add": {"type": "gyro", "object": "site0"}}})
    assert names(only) == ["w"]


def test_the_same_rule_holds_for_environments():
    sections, use, assumed = sensors.sections(None, mujoco.MjModel.from_xml_string(ROBOT))
    assert (list(sections), use, assumed) == (USUAL, None, True)


@pytest.mark.parametrize(
    ("add", "expected"),
    [
        ({"type": "jointvel", "object": "*"}, ["joint1_v", "joint3_v"]),
        ({"type": "ballquat", "object": "*"}, ["joint3__v"]),
        ({"type": "jointpos", "object": 2}, ["v"]),
        ({"type": "jointpos", "object": ["joint3", 1]}, ["joint3_v", "joint1_v"]),
        (
            {"type": "gyro", "object": "body[23]", "object_type": "body"},
            ["body2_v", "body3_v"],
        ),
    ],
)
def test_one_entry_for_many_objects(made, add, expected):
    setup = made(
        channels={"v": {"add": add, "noise": 0.3}},
        sensors=["v"],
        estimators={"ekf": {}, "ukf": {"filter": {"channels": {"v": {"noise": 0.9}}}}},
        filter={"channels": {"v": {"noise": 0.6}}},
    )
    assert names(setup) == expected
    assert all(c.cov[0, 0] == pytest.approx(0.09) for c in setup.channels)
    for label, variance in (("ekf", 0.36), ("ukf", 0.81)):
        believed = setup.believed[label].channels
        assert all(c.cov[0, 0] == pytest.approx(variance) for c in believed)


@pytest.mark.parametrize(
    ("obj", "message"),
    [
        (9, r"channels\.v\.add\.object: no joint 9; there are 4, numbered from 0"),
        ([], r"channels\.v\.add\.object is an empty list"),
        ("x*", r"channels\.v\.add\.object: 'x\*' matches no joint that a jointpos fits"),
        (["joint9"], r"channels\.joint9_v\.add\.object: robot\.xml has no joint 'joint9'"),
    ],
)
def test_objects_that_are_not_there(made, obj, message):
    with pytest.raises(ScenarioError, match=message):
        made(channels={"v": {"add": {"type": "jointpos", "object": obj}}})


def test_a_name_that_is_taken(made):
    add = {"type": "jointpos", "object": "*"}
    other = {"add": {"type": "jointvel", "object": 1}}
    with pytest.raises(ScenarioError, match=r"channels\.v\.add\.object: a channel 'joint1_v'"):
        made(channels={"v": {"add": add}, "joint1_v": other})


def test_channels_without_noise_share_a_line(made):
    setup = made(channels={"v": {"add": {"type": "jointpos", "object": "*"}}})
    assumed = [line for line in setup.notices if "no noise given" in line]
    assert assumed == ["no noise given; assuming 0.01 rad (joint1_v), 0.01 m (joint3_v)"]
