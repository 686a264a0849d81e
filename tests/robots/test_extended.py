"""Sensors added to a compiled model, against MuJoCo's own compiler."""

from types import SimpleNamespace

import gymnasium as gym
import mujoco
import numpy as np
import pytest

from estbench.errors import ScenarioError
from estbench.robots import added_sensors, extended, flags, mjcf

SENSORS = {
    "Ant": {"gyro": ("gyro", "torso", "body"), "knee": ("jointpos", "ankle_1", None)},
    "Humanoid": {
        "acceleration": ("accelerometer", "torso", "body"),
        "place": ("framepos", "left_foot", "geom"),
        "motor": ("actuatorfrc", "abdomen_y", None),
        "mass": ("subtreelinvel", "pelvis", None),
    },
    "Reacher": {"tip": ("framepos", "fingertip", "body"), "time": ("clock", None, None)},
    "Pusher": {
        "fix": ("framequat", "tips_arm", "xbody"),
        "speed": ("jointvel", "obj_slidex", None),
    },
}  # fmt: skip

TWO = """<mujoco><asset><mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset><worldbody>
  <camera name="eye" resolution="8 6"/>
  <body name="a"><freejoint/><geom type="mesh" mesh="m"/><site name="first"/>
  <body name="b" pos="1 0 0"><joint name="hinge" pos="0 1 0"/><geom size="0.1"/>
  <site name="second"/><body pos="0 1 0"><joint type="ball"/><geom size="0.1"/></body></body></body>
  </worldbody>
  <tendon><spatial name="cord"><site site="first"/><site site="second"/></spatial></tendon>
  <actuator><general name="pull" tendon="cord" dyntype="integrator"/></actuator>
  <equality><connect body1="a" body2="b" anchor="0 0 1" active="false"/></equality>
  <sensor><gyro name="own" site="second"/><framepos objtype="site" objname="second"/></sensor>
</mujoco>"""


def wanted(table):
    return {
        name: SimpleNamespace(type=kind, object=at, object_type=of)
        for name, (kind, at, of) in table.items()
    }


def same_but_for_sensors(before, after):
    for name in extended._ARRAYS:
        a, b = extended._array(before, name), extended._array(after, name)
        if name.startswith(("site_", "sensor_")):
            b = b[: len(a)]
        if name not in ("names", "names_map", "name_siteadr", "name_sensoradr"):
            np.testing.assert_array_equal(a, b, err_msg=name)
    assert before.opt.timestep == after.opt.timestep
    assert before.stat.extent == after.stat.extent


def names_are_found(model):
    for kind, count in (("BODY", "nbody"), ("SITE", "nsite"), ("SENSOR", "nsensor")):
        enum = getattr(mujoco.mjtObj, f"mjOBJ_{kind}")
        for i in range(getattr(model, count)):
            name = mujoco.mj_id2name(model, enum, i)
            assert not name or mujoco.mj_name2id(model, enum, name) == i


def readings(model, names, seed=0):
    rng, data = np.random.default_rng(seed), mujoco.MjData(model)
    mujoco.mj_integratePos(model, data.qpos, rng.normal(0, 0.3, model.nv), 1.0)
    data.qvel[:], data.ctrl[:] = rng.normal(0, 1, model.nv), rng.normal(0, 1, model.nu)
    mujoco.mj_forward(model, data)
    return np.concatenate([data.sensor(name).data for name in names])


@pytest.mark.parametrize("robot", SENSORS)
def test_as_if_the_sensors_stood_in_the_mjcf(robot):
    base, sensors = gym.make(f"{robot}-v5").unwrapped, wanted(SENSORS[robot])
    spec = mujoco.MjSpec.from_file(base.fullpath)
    added_sensors.add(spec, sensors, robot)
    compiled = mjcf.compile_model(spec)
    model = extended.with_sensors(base.model, sensors, robot)
    same_but_for_sensors(base.model, model)
    names_are_found(model)
    for field in ("type", "datatype", "needstage", "dim", "objtype", "reftype"):
        a, b = (getattr(m, f"sensor_{field}") for m in (compiled, model))
        np.testing.assert_array_equal(a, b, err_msg=field)
    flags.set_flags(model)
    a, b = (readings(m, sensors) for m in (compiled, model))
    np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


def test_sensors_beside_those_that_a_model_has():
    before = mujoco.MjModel.from_xml_string(TWO)
    before.geom_size[1] = 0.3
    table = {
        "site": ("framelinvel", "second", "site"), "imu": ("accelerometer", "b", "body"),
        "turn": ("ballquat", "joint2", None), "cord": ("tendonpos", "cord", None),
        "body": ("framepos", "body3", "body"), "more": ("gyro", "a", "body"),
    }  # fmt: skip
    after = extended.with_sensors(before, wanted(table), "robot")
    same_but_for_sensors(before, after)
    names_are_found(after)
    assert after.nsite == before.nsite + 2
    data = mujoco.MjData(after)
    data.qvel[3:6] = [1.0, 2.0, 3.0]
    mujoco.mj_forward(after, data)
    np.testing.assert_allclose(data.sensor("more").data, [1.0, 2.0, 3.0], atol=1e-12)
    np.testing.assert_allclose(data.sensor("own").data, data.sensor("more").data, atol=1e-12)
    np.testing.assert_allclose(data.sensor("body").data, data.xpos[3])
    np.testing.assert_array_equal(data.sensor("turn").data, data.qpos[8:12])
    again = extended.with_sensors(after, wanted({"last": ("gyro", "b", "body")}), "robot")
    same_but_for_sensors(after, again)
    assert again.sensor("last").id == after.nsensor


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"own": ("clock", None, None)}, "robot has a sensor 'own' already"),
        ({"x": ("jointpos", "hing", None)}, "no joint 'hing' .did you mean 'hinge'"),
        ({"x": ("jointpos", "joint2", None)}, "sensors: MJCF does not compile: .*slide or hinge"),
        ({"x": ("gyrro", "b", "body")}, "no sensor type 'gyrro' .did you mean 'gyro'"),
    ],
)
def test_mistakes(entry, message):
    with pytest.raises(ScenarioError, match=message):
        extended.with_sensors(mujoco.MjModel.from_xml_string(TWO), wanted(entry), "robot")
