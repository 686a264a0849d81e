import copy

import mujoco
import numpy as np
import pytest

from estbench.robots import flags
from tests.helpers import ZOO, zoo_model


@pytest.mark.parametrize("name", sorted(ZOO))
@pytest.mark.parametrize(
    ("use", "stage", "fields"),
    [
        ("step", mujoco.mjtStage.mjSTAGE_ACC, ["qacc"]),
        ("velocity", mujoco.mjtStage.mjSTAGE_VEL, ["sensordata"]),
        ("acceleration", mujoco.mjtStage.mjSTAGE_ACC, ["sensordata", "qacc"]),
    ],
)
def test_the_reduced_copy_gives_the_same_to_the_last_bit(name, use, stage, fields):
    model = zoo_model(name)
    smaller = flags.reduced(model, use)
    datas = mujoco.MjData(model), mujoco.MjData(smaller)
    seen = model.sensor_needstage <= int(stage)
    columns = np.concatenate(
        [np.arange(d) + a for a, d, s in zip(model.sensor_adr, model.sensor_dim, seen) if s] or [[]]
    ).astype(int)
    rng = np.random.default_rng(0)
    for _ in range(20):
        qpos = datas[0].qpos.copy()
        qvel, ctrl = rng.normal(size=model.nv), rng.normal(size=model.nu)
        got = []
        for m, d in zip((model, smaller), datas):
            d.qpos[:], d.qvel[:], d.ctrl[:] = qpos, qvel, ctrl
            mujoco.mj_forwardSkip(m, d, mujoco.mjtStage.mjSTAGE_NONE, 0)
            got.append([d.sensordata[columns] if f == "sensordata" else d.qacc for f in fields])
            got[-1] = [values.copy() for values in got[-1]]
            mujoco.mj_step(m, d)
            if use != "velocity":
                got[-1] += [d.qpos.copy(), d.qvel.copy(), d.act.copy()]
        for one, other in zip(*got):
            np.testing.assert_array_equal(one, other)


def test_the_reduced_copy_leaves_out_only_what_does_nothing():
    bits = mujoco.mjtDisableBit
    skipped = bits.mjDSBL_CONTACT | bits.mjDSBL_CONSTRAINT

    def left_out(text):
        model = mujoco.MjModel.from_xml_string(text)
        return flags.reduced(model, "acceleration").opt.disableflags & skipped

    ball = """<mujoco><worldbody>
        <body><joint type="slide" {}/><geom size="1" {}/></body>{}
    </worldbody></mujoco>"""
    alone, floor = 'contype="0"', '<geom type="plane" size="1 1 1"/>'
    assert left_out(ball.format("", alone, "")) == skipped
    assert left_out(ball.format("", "", floor)) == 0
    assert left_out(ball.format('range="-1 1" limited="true"', alone, "")) == bits.mjDSBL_CONTACT
    assert left_out(ball.format('frictionloss="1"', alone, "")) == bits.mjDSBL_CONTACT


def test_a_sensor_that_is_not_in_use_is_not_computed():
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint name='j' axis='0 1 0'/><geom size='.1' pos='.3 0 0'/>"
        "<site name='s'/></body></worldbody><sensor><gyro site='s'/><accelerometer site='s'/>"
        "<velocimeter site='s'/></sensor></mujoco>"
    )
    spared = copy.copy(model)
    flags.leave_out_sensors(spared, {1})
    readings = []
    for m in (model, spared):
        data = mujoco.MjData(m)
        data.qvel[:] = 1.0
        mujoco.mj_forward(m, data)
        readings.append(data.sensordata.copy())
    assert readings[0][:3].any()
    np.testing.assert_array_equal(readings[1][3:6], readings[0][3:6])
    assert not readings[1][:3].any()
    assert not readings[1][6:].any()
