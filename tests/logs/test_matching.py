"""A first `[log]` for a scenario, by names, units and ranges."""

import tomllib

import numpy as np
import pytest

from estbench.commands import cli
from estbench.logs import files
from estbench.logs.inspect import section
from estbench.scenario.load import load

T = np.arange(100) * 0.01


def proposed(tmp_path, scenario, **columns):
    np.savez(tmp_path / "log.npz", time=T, **columns)
    return tomllib.loads(section(files.read_all([tmp_path / "log.npz"]), load(scenario)))["log"]


def test_joints_go_by_kind_and_order(tmp_path):
    """The headings of a recorded double pendulum."""
    names = ("pos_meas1", "pos_meas2", "vel_meas1", "vel_meas2", "tau_meas1", "tau_meas2")
    found = proposed(tmp_path, "real_double_pendulum", **dict.fromkeys(names, np.sin(T)))
    own = {name: part["columns"] for name, part in found["channels"].items()}
    assert own == {
        "shoulder_encoder": ["pos_meas1"], "elbow_encoder": ["pos_meas2"],
        "shoulder_speed": ["vel_meas1"], "elbow_speed": ["vel_meas2"],
    }  # fmt: skip
    assert [c["columns"] for c in found["controls"].values()] == [["tau_meas1"], ["tau_meas2"]]
    assert (found["time"], found["unit"]) == ("time", "s")


def test_axes_stay_together_and_degrees_are_named(tmp_path):
    axes = {f"imu_angular_velocity_{a}": 300 * np.sin(T + i) for i, a in enumerate("xyz")}
    found = proposed(tmp_path, "pendulum", joint_angle=np.sin(T), picture=T**2, **axes)
    assert found["channels"]["gyro"] == {"columns": sorted(axes), "unit": "deg/s"}
    assert found["channels"]["encoder"] == {"columns": ["joint_angle"]}
    assert "controls" not in found  # nothing fits, which a comment says


def test_the_command(tmp_path, monkeypatch, capsys):
    (tmp_path / "log.csv").write_text("time,position,torque\n0,1,2\n0.01,1,2\n", encoding="utf-8")
    monkeypatch.setattr(
        "sys.argv", ["estbench", "replay", "--inspect", "real_pendulum", str(tmp_path / "log.csv")]
    )
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert not ended.value.code
    out = capsys.readouterr().out
    assert "[log.channels.encoder]" in out
    assert "# no column fits channel speed" in out
