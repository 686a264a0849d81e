"""Values of MuJoCo sensors that mean "nothing": from the raw value to +inf."""

import mujoco
import numpy as np
import pytest

from estbench.robots import mjcf, no_return
from estbench.robots.backend import create
from estbench.robots.measurement import Measurand, Plan

ROBOT = """<mujoco><option gravity="0 0 0"/>
<worldbody><geom name="wall" type="box" size=".5 .5 .5" pos="0 0 3"/>
 <camera name="sky" pos="0 0 9" euler="180 0 0" resolution="2 1"/>
 <body name="b"><joint name="j" type="slide" axis="0 0 1" limited="true" range="-9 2.3"/>
  <geom name="g" type="sphere" size=".1" mass="1"/><site name="up" pos=".6 0 0"/>
  <site name="ahead"/></body></worldbody>
<tendon><fixed name="t" limited="true" range="-9 2.2"><joint joint="j" coef="1"/></fixed></tendon>
<sensor>{}</sensor></mujoco>"""
TOUCHING, FREE = 2.41, 0.0
SENSORS = [
    ('<rangefinder site="ahead"/>', FREE, '<rangefinder site="up"/>', FREE),
    ('<rangefinder site="ahead" cutoff="3"/>', FREE, '<rangefinder site="up" cutoff=".5"/>', FREE),
    (
        '<rangefinder site="ahead" data="dist dir point normal depth"/>', FREE,
        '<rangefinder site="up" data="dist dir point normal depth"/>', FREE,
    ),
    ('<rangefinder site="ahead" data="normal"/>', FREE, '<rangefinder site="up" data="normal"/>',
     FREE),
    ('<distance geom1="g" geom2="wall" cutoff="3"/>', FREE,
     '<distance geom1="g" geom2="wall" cutoff="1"/>', FREE),
    ('<distance geom1="g" geom2="wall"/>', TOUCHING, '<distance geom1="g" geom2="wall"/>', FREE),
    ('<normal geom1="g" geom2="wall" cutoff="3"/>', FREE,
     '<normal geom1="g" geom2="wall" cutoff="1"/>', FREE),
    ('<fromto geom1="g" geom2="wall" cutoff="3"/>', FREE,
     '<fromto geom1="g" geom2="wall" cutoff="1"/>', FREE),
    ('<contact geom1="g" geom2="wall"/>', TOUCHING, '<contact geom1="g" geom2="wall"/>', FREE),
    ('<contact geom1="g" data="force dist pos"/>', TOUCHING,
     '<contact geom1="g" data="force dist pos"/>', FREE),
    ('<jointlimitpos joint="j"/>', TOUCHING, '<jointlimitpos joint="j"/>', FREE),
    ('<jointlimitvel joint="j"/>', TOUCHING, '<jointlimitvel joint="j"/>', FREE),
    ('<tendonlimitpos tendon="t"/>', TOUCHING, '<tendonlimitpos tendon="t"/>', FREE),
    ('<tendonlimitvel tendon="t"/>', TOUCHING, '<tendonlimitvel tendon="t"/>', FREE),
]  # fmt: skip


def read(sensor: str, height: float) -> np.ndarray:
    """The reading of a sensor at a height of the body that moves by 0.3 m/s."""
    model = mjcf.compile_model(mujoco.MjSpec.from_string(ROBOT.format(sensor)))
    plan = Plan(model, [Measurand.of_sensors(model, 0)])
    return plan.read(create(model), np.array([[height, 0.3]]), np.zeros((1, 0)), 0.0)[0]


@pytest.mark.parametrize(("sensor", "height", "without", "there"), SENSORS)
def test_a_value_that_means_nothing_is_infinite_and_any_other_is_not(
    sensor: str, height: float, without: str, there: float
) -> None:
    """Of each type with such a value, a reading and one without a return."""
    assert np.isfinite(read(sensor, height)).all()
    assert np.isposinf(read(without, there)).all()


@pytest.mark.parametrize("sensor", [
    '<touch site="ahead"/>', '<jointlimitfrc joint="j"/>', '<tendonlimitfrc tendon="t"/>',
    '<insidesite objtype="body" objname="b" site="up"/>',
])  # fmt: skip
def test_a_zero_that_is_a_value_stays(sensor: str) -> None:
    """No force is a force of 0 N, and outside of a site is an answer."""
    assert read(sensor, FREE).tolist() == [0.0]


def test_rays_and_contacts_are_missing_one_by_one() -> None:
    """Of several slots only those without a return are infinite; the origin of a ray always is."""
    two = read('<contact geom1="g" data="found dist" num="2"/>', TOUCHING)
    assert np.isfinite(two).tolist() == [True, True, False, False]
    sky = read('<rangefinder camera="sky" data="dist origin"/>', FREE)
    assert np.isfinite(sky).tolist() == [False, True, True, True] * 2


def test_a_single_axis_is_missing_with_its_sensor() -> None:
    """The axis that is read may be 0 with a return: the whole sensor decides."""
    for cutoff, expected in ((3, 0.0), (1, np.inf)):
        sensor = f'<normal geom1="g" geom2="wall" cutoff="{cutoff}"/>'
        model = mjcf.compile_model(mujoco.MjSpec.from_string(ROBOT.format(sensor)))
        plan = Plan(model, [Measurand.of_sensors(model, 0, axes=[1])])
        y = plan.read(create(model), np.zeros((1, 2)), np.zeros((1, 0)), 0.0)
        assert y.tolist() == [[expected]]


def test_a_user_sensor_that_nothing_computes_never_returns() -> None:
    """MuJoCo leaves its reading at zero."""
    assert np.isposinf(read('<user dim="2"/>', FREE)).all()
    model = mjcf.compile_model(mujoco.MjSpec.from_string(ROBOT.format('<user dim="2"/>')))
    assert no_return.never_returns(model, 0)


def test_a_state_that_cannot_be_computed_is_no_missing_return() -> None:
    """Its reading stays NaN: the run has failed."""
    model = mjcf.compile_model(mujoco.MjSpec.from_string(ROBOT.format('<rangefinder site="up"/>')))
    plan = Plan(model, [Measurand.of_sensors(model, 0)])
    x = np.array([[np.nan, 0.0], [0.0, 0.0]])
    y = plan.read(create(model), x, np.zeros((2, 0)), 0.0)[:, 0]
    assert np.isnan(y[0])
    assert np.isposinf(y[1])
