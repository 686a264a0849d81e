import numpy as np
import pytest

from estbench.errors import StudyError
from estbench.experiment.setup import build
from estbench.scenario.load import parse, resolve
from estbench.study import keys


@pytest.mark.parametrize(
    ("key", "names"),
    [
        ("filter.process_noise_scale", ("filter", "process_noise_scale")),
        ("filter.set.body_mass.pole", ("filter", "set", "body_mass.pole")),
        ('filter.set."body_mass.pole"', ("filter", "set", "body_mass.pole")),
        ("filter.process_noise.density.a.vel", ("filter", "process_noise", "density", "a.vel")),
        ("start.inflate.pole.vel", ("start", "inflate", "pole.vel")),
        ("estimators.e.start.inflate.a.vel", ("estimators", "e", "start", "inflate", "a.vel")),
        ("filter.channels.gyro.noise.x", ("filter", "channels", "gyro", "noise", "x")),
    ],
)  # fmt: skip
def test_parts_of_a_key(key, names):
    assert keys.parse(key) == names


@pytest.mark.parametrize("key", ["", "a b", "=3", "# comment"])
def test_what_is_no_key(key):
    with pytest.raises(StudyError, match="not a dotted key"):
        keys.parse(key)


def test_a_table_in_place_of_a_number_leaves_the_number_to_the_other_names():
    scenario = resolve("cartpole")
    made = keys.changed(scenario, {keys.parse("start.inflate.pole.vel"): 3.0})
    assert made.start.inflate == {"*": 1.0, "pole.vel": 3.0}


def test_keys_that_do_not_exist():
    scenario = resolve("cartpole")
    with pytest.raises(StudyError, match=r"process_noise_scal: unknown key \(did you mean"):
        keys.changed(scenario, {("filter", "process_noise_scal"): 1.0})
    with pytest.raises(StudyError, match="which has no part 'x'"):
        keys.changed(scenario, {("name", "x"): 1.0})


def test_what_a_scenario_does_not_say_stays_unsaid(tmp_path):
    """The default of initial.std depends on the robot: with constraints it is a tenth."""
    (tmp_path / "two.xml").write_text("""
<mujoco><worldbody>
  <body><joint name="a" axis="0 1 0"/><geom size="0.1" pos="0 0 -1"/></body>
  <body><joint name="b" axis="0 1 0"/><geom size="0.1" pos="0 0 -1"/></body></worldbody>
  <equality><joint joint1="a" joint2="b"/></equality>
  <sensor><jointpos name="e" joint="a" noise="0.01"/></sensor></mujoco>""")
    scenario = resolve(tmp_path / "two.xml", ["ekf"])
    own = build(scenario).cov
    same = keys.changed(scenario, {("filter", "process_noise_scale"): 2.0})
    np.testing.assert_array_equal(build(same).cov, own)
    np.testing.assert_array_equal(build(parse(scenario.to_toml())).cov, own)
    wider = keys.changed(scenario, {("initial", "std", "a"): 0.5})
    assert wider.initial.std == {"*": 0.05, "a": 0.5}
