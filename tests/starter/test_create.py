"""A first scenario for a robot: what is on, of what size, and that it runs."""

import tomllib

import numpy as np
import pytest

import estbench
from estbench.commands import cli
from estbench.errors import ScenarioError
from estbench.experiment import setup
from estbench.scenario.files import bundled
from estbench.scenario.load import load
from estbench.starter import control, noise
from estbench.starter.create import create
from estbench.starter.robot import EARTH, Robot
from estbench.starter.sensors import asked
from tests.helpers import ACTIVATIONS, JOINTS


def mjcf(name):
    folder = bundled()[name].parent
    return str(next(p for p in folder.glob("*.xml")))


def test_the_bare_robot_gets_encoders_and_runs(tmp_path):
    """A robot without sensors: two hinges that nothing balances, and a servo."""
    (tmp_path / "arm.xml").write_text(
        '<mujoco><worldbody><body><joint name="a.b" axis="0 1 0" damping="0.1"/>'
        '<geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.5" mass="1" contype="0"/>'
        '<body pos="0 0 -0.5"><joint name="two" axis="0 1 0" damping="0.1"/>'
        '<geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="0.5" contype="0"/>'
        '</body></body></worldbody><actuator><position name="servo" joint="two" kp="5" '
        'ctrlrange="-1 1"/></actuator></mujoco>'
    )
    out = create(str(tmp_path / "arm.xml"))
    assert out == tmp_path / "scenario.toml"
    data = tomllib.loads(out.read_text())
    assert data["model"]["path"] == "arm.xml"
    assert data["control"]["kind"] == "sine"
    assert data["control"]["amplitude"] == pytest.approx(0.1)
    assert list(data["channels"]) == ["encoder"]  # of both joints
    results = estbench.run(out, runs=10, duration=1.0)
    assert {s.label for s in results.summaries} == {"ekf", "ukf"}
    assert all(0.6 < s.anees.value < 1.5 for s in results.summaries)  # 3200 values, 10 runs
    with pytest.raises(ScenarioError, match="exists; give another name by --out"):
        create(str(tmp_path / "arm.xml"))


def test_comments_become_channels(tmp_path):
    """What is a comment is valid: with every group on, each channel of the file can be built."""
    (tmp_path / "zoo.xml").write_text(JOINTS)
    all_on = create(str(tmp_path / "zoo.xml"), tmp_path / "all.toml", ("encoders", "position",
                                                                       "imu"))  # fmt: skip
    needed = create(str(tmp_path / "zoo.xml"), tmp_path / "needed.toml")
    uncommented = needed.read_text().replace("# [channels", "[channels").replace(
        "# add = ", "add = "
    )  # fmt: skip
    wanted = load(all_on).channels
    assert wanted.keys() == tomllib.loads(uncommented)["channels"].keys()
    # The MJCF has an encoder on the slide and on the ball; the free body's attitude is measured at
    # a site of it, and so is its rate.
    names = {c.name for c in setup.build(load(all_on)).channels}
    assert {"lift_encoder", "wrist_quat", "attitude", "gyro", "swing_encoder"} <= names
    assert sum("position" in name for name in names) == 1
    assert not any("attitude" in name or "gyro" in name for name in wanted.keys() - names)


def test_only_what_is_needed_is_on():
    """The quadruped's own sensors do not see where it is; the cart-pole's see all."""
    robot = Robot.read(mjcf("quadruped"))
    assert robot.free == (robot.base,)
    assert robot.servos().all()
    assert control.choose(Robot.read(mjcf("cartpole"))).kind == "lqr"


def test_a_file_that_is_there_or_a_group_that_is_not(tmp_path):
    with pytest.raises(ScenarioError, match=r"--sensors has 'encoder' .did you mean 'encoders'"):
        asked("imu,encoder")
    assert asked(" imu, position") == ("imu", "position")
    assert asked(None) is None
    with pytest.raises(ScenarioError, match="no file"):
        create(str(tmp_path / "none.xml"))
    (tmp_path / "rigid.xml").write_text("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    with pytest.raises(ScenarioError, match="has no joint"):
        create(str(tmp_path / "rigid.xml"))
    (tmp_path / "zoo.xml").write_text(JOINTS)
    with pytest.raises(ScenarioError, match="cannot be written"):
        create(str(tmp_path / "zoo.xml"), tmp_path / "no" / "where.toml")


def test_noise_is_of_the_size_of_the_robot(tmp_path):
    """A free body of mass m: 2 τ (s m g)² along the axes. A motor weaker than that sets its own."""
    path = tmp_path / "two.xml"
    path.write_text(
        "<mujoco><worldbody><body><freejoint/><geom size='0.1' mass='3'/></body>"
        "<body pos='1 0 0'><joint name='s' type='slide' axis='1 0 0'/><geom size='.1' mass='2'/>"
        "</body></worldbody><actuator><motor joint='s' gear='2' ctrlrange='-0.5 0.25'/></actuator>"
        "</mujoco>"
    )
    q = noise.density(Robot.read(str(path)))
    np.testing.assert_allclose(q[:3], 0.2 * (0.02 * 3 * EARTH) ** 2)
    np.testing.assert_allclose(q[6], 0.2 * (0.02 * 1.0) ** 2)
    rho = np.sqrt(0.4) * 0.1  # of a sphere
    np.testing.assert_allclose(q[3:6], 0.2 * (0.02 * 3 * EARTH * rho) ** 2)
    assert (noise.density(_activated(tmp_path)) > 0).all()


def _activated(tmp_path):
    path = tmp_path / "act.xml"
    path.write_text(ACTIVATIONS.format(integrator="Euler"))
    return Robot.read(str(path))


def test_the_commands(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "zoo.xml").write_text(JOINTS)

    def said(*words):
        monkeypatch.setattr("sys.argv", ["estbench", *words])
        with pytest.raises(SystemExit) as exit_:
            cli.main()
        return exit_.value.code, capsys.readouterr()

    code, printed = said("new", "zoo.xml", "--sensors", "imu")
    assert not code
    assert "written: scenario.toml" in printed.out
    code, printed = said("new", "zoo.xml")
    assert (code, printed.err.count("\n")) == (2, 1)
    assert not said("check", "scenario.toml")[0]
    code, printed = said("schema")
    assert not code
    assert '"ChannelSection"' in printed.out
