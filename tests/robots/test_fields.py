"""The fields of a model: read, compared, given, and seen to change."""

import mujoco
import numpy as np
import pytest

from estbench.errors import ScenarioError
from estbench.robots import fields, flags
from tests.envs.changing import ARM


def arm(**changes):
    text = ARM
    for old, new in changes.values():
        text = text.replace(old, new)
    return mujoco.MjModel.from_xml_string(text)


def test_differences_are_found_and_given_to_another_model():
    model, base = arm(), arm()
    flags.set_flags(base)
    reference = fields.Reference(base)
    assert not reference.differences(fields.read(model))  # the flags are estbench's own
    model.body_mass[2], model.opt.gravity[0], model.eq_active0[0] = 7.0, 1.0, 0
    model.opt.iterations, model.actuator_gainprm[0, 0], model.geom_rgba[:] = 3, 2.0, 0.1
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    found = reference.differences(fields.read(model))
    assert set(found) == {
        "body_mass", "eq_active0", "actuator_gainprm", "opt.gravity", "opt.iterations",
        "opt.disableflags",
    }  # fmt: skip
    made = fields.given(base, found)
    assert not fields.Reference(made).differences(fields.read(model))
    assert base.body_mass[2] != 7.0
    assert made.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_WARMSTART)


TENDON = '</worldbody><tendon><fixed><joint joint="elbow" coef="1"/></fixed></tendon>'
MOTOR = '<motor name="motor" joint="shoulder" ctrlrange="-1 1" ctrllimited="true"/>'


@pytest.mark.parametrize(
    ("change", "name"),
    [
        (('<body name="hand"', '<body name="more"/><body name="hand"'), "body_parentid has the"),
        (("</worldbody>", TENDON), "has the shape .* another one"),
        ((MOTOR, ""), "actuator_.* is gone"),
    ],
)
def test_another_robot_is_refused(change, name):
    reference = fields.Reference(arm())
    with pytest.raises(ScenarioError, match=name + ".*make a new filter"):
        reference.differences(fields.read(arm(change=change)))


def test_every_word_that_changes_is_seen_once():
    model = arm()
    looked = fields.Looked(model)
    assert not looked.again()
    for name in ("body_mass", "dof_damping", "actuator_gainprm", "eq_solref", "qpos0", "geom_pos"):
        getattr(model, name).flat[-1] += 0.25
        assert looked.again(), name
        assert not looked.again()
    model.jnt_limited[-1] = 1
    assert looked.again()
    model.opt.wind[2] = 1.0
    assert looked.again()
    model.opt.iterations += 1
    assert not looked.again()
    assert looked.again(thorough=True)
    terrain = mujoco.MjModel.from_xml_string("""<mujoco><asset>
      <hfield name="h" nrow="3" ncol="3" size="1 1 1 1"/></asset><worldbody>
      <geom type="hfield" hfield="h"/><body><freejoint/><geom size="1"/></body></worldbody>
      </mujoco>""")
    looked = fields.Looked(terrain)
    terrain.hfield_data[4] = 0.5
    assert looked.again(thorough=True)
    assert "hfield_data" in fields.Reference(terrain).differences(
        {**fields.read(terrain), "hfield_data": np.zeros(9, np.float32)}
    )
