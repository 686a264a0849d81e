"""A channel is the same in `estbench check`, `estbench sensors` and the report."""

import sys

import pytest

import estbench
from estbench.commands import cli
from estbench.report import facts, sources

ROBOT = """
<mujoco><option timestep="0.002"/>
<worldbody><body><joint name="x" type="slide"/><geom size="0.1" mass="1"/>
<site name="imu"/></body></worldbody>
<sensor><jointpos name="fast" joint="x" interval="0.0033" nsample="4"/>
<accelerometer name="accel" site="imu" noise="0.2"/><gyro name="gyro" site="imu" noise="0.01"/>
</sensor></mujoco>"""
SETTINGS = (
    "channels.fast.noise_density=0.001",
    "channels.imu={of=['accel', 'gyro'], noise=[0.2, 0.2, 0.2, 0.01, 0.01, 0.01]}",
    "filter.channels.fast.noise=0.5",
)
ROWS = {
    # 1/0.0033 s, although the physics steps have 500 Hz; σ = 0.001/sqrt(0.0033 s).
    "fast": ["fast", "jointpos", "0.0174", "m", "303.03 Hz"],
    "imu": ["imu", "accelerometer + gyro", "0.2, 0.01", "m/s², rad/s", "500 Hz"],
}


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    path = tmp_path_factory.mktemp("robot") / "robot.xml"
    path.write_text(ROBOT)
    return path


@pytest.mark.parametrize("command", ["check", "sensors"])
@pytest.mark.parametrize("name", ROWS)
def test_the_command_line(command, name, robot, monkeypatch, capsys):
    words = [word for setting in SETTINGS for word in ("--set", setting)]
    monkeypatch.setattr(sys, "argv", ["estbench", command, str(robot), *words])
    with pytest.raises(SystemExit) as exit_:
        cli.main()
    assert not exit_.value.code
    (line,) = [
        one for one in capsys.readouterr().out.splitlines() if one.strip("│ ").startswith(name)
    ]
    assert " ".join(line.replace("│", " ").split()).startswith(" ".join(ROWS[name]))


def test_the_report(robot, tmp_path):
    folder = tmp_path / "results"
    estbench.run(robot, ["ekf"], runs=2, duration=0.1, overrides=SETTINGS, out=folder)
    (entry,) = sources.load([folder])
    found = facts.facts(entry.source)
    rows = {row[0]: list(row) for row in found.sensors}
    assert {name: rows[name][:5] for name in ROWS} == ROWS
    assert all(len(row) == len(found.headings) for row in found.sensors)
    assert "filter: fast: noise σ 0.5" in found.differences
