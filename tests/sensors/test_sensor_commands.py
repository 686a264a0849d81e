"""Sensors on the command line: what is refused, in one line, and what is said of late readings."""

import re
import sys

import pytest

from estbench.commands import cli

SHORT = ("--runs", "4", "--duration", "0.5", "-e", "ekf")


def halved(t):
    return 0.5


@pytest.fixture
def call(tmp_path, monkeypatch, capfd):
    """The command line in this process: exit code, standard output and error."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["estbench", *arguments])
        with pytest.raises(SystemExit) as exit_:
            cli.main()
        return exit_.value.code or 0, *capfd.readouterr()

    return run


# Settings of quadrotor_delayed -> what is said
BAD = {
    "channels.position.noise=-0.1": r"channels\.position\.noise is -0\.1; .*use a std above 0",
    "channels.position.noise=[0.1, -0.1, 0.1]": r"position\.noise is -0\.1; .*use a std above 0",
    "channels.position.bias=-0.1": r"channels\.position\.bias: .*equal to 0, got -0\.1$",
    "channels.gyro.bias_walk=[0.1, -1]": r"gyro\.bias_walk: .*equal to 0, got \[0\.1, -1\.0\]$",
    "filter.channels.gyro.noise=-1": r"filter\.channels\.gyro\.noise is -1; .*a std above 0$",
    "channels.height.latency_std=-1": r"height\.latency_std: .*equal to 0, got -1$",
    "channels.height.dropout=1.2": r"channels\.height\.dropout: .*less than 1, got 1\.2$",
    "channels.height.dropout=-0.1": r"channels\.height\.dropout: .*equal to 0, got -0\.1$",
    "channels.height.outlier_probability=1.5": r"outlier_probability: .*less than 1, got 1\.5$",
    "channels.height.stuck=-0.5": r"channels\.height\.stuck: .*equal to 0, got -0\.5$",
    "filter.window=0.05": r"filter\.window is 0\.05 s but channel 'position' is 0\.08 s late",
    "channels.posiiton.rate=9": r"channels: no sensor 'posiiton' \(did you mean 'position'\?\)",
    "sensors=['gyroo']": r"sensors: no sensor 'gyroo' \(did you mean 'gyro'\?\)",
    "channels.imu.of=['acel']": r"channels\.imu\.of: no sensor 'acel' \(did you mean 'accel'\?\)",
    "filter.channels.heigth.noise=1": r"no channel 'heigth' \(did you mean 'height'\?\)",
    "channels.compass={cov=[[1, 0], [0, 1]], add={type='magnetometer', object='imu'}}":
        r"compass\.cov has shape \(2, 2\); expected \(3, 3\) \(compass\.x, compass\.y, compass\.z",
    "channels.gyro.cov=[[1, 2, 0], [2, 1, 0], [0, 0, 1]]":
        r"channels\.gyro\.cov \(R\) is not symmetric positive definite$",
    "filter.channels.gyro.cov=[[1, 2, 0], [2, 1, 0], [0, 0, 1]]":
        r"filter\.channels\.gyro\.cov \(R\) is not symmetric positive definite$",
    "channels.gyro.schedule=[[2.0, 1.0]]":
        r"gyro\.schedule ends at 2 s but the run at 5 s; extend its last row",
    "process_noise.schedule=[[2.0, 1.0]]":
        r"process_noise\.schedule ends at 2 s but the run at 5 s; extend its last row",
    "channels.gyro.schedule='tests.sensors.test_sensor_commands:halve'":
        r"has no function 'halve' \(did you mean 'halved'",
}  # fmt: skip


@pytest.mark.parametrize("command", ["run", "check", "sensors"])
@pytest.mark.parametrize("setting", BAD)
def test_bad_input_is_one_line_and_leaves_nothing_behind(command, setting, call, tmp_path):
    code, out, err = call(command, "quadrotor_delayed", "--set", setting)
    assert (code, out) == (2, "")
    assert err.startswith("estbench: ")
    assert err.count("\n") == 1
    assert re.search(BAD[setting], err.rstrip("\n")), err
    assert not list(tmp_path.iterdir())


def test_a_function_of_the_time_is_a_schedule(call):
    setting = f"channels.gyro.schedule='{__name__}:halved'"
    code, out, err = call("sensors", "quadrotor_delayed", "--set", setting)
    assert (code, err) == (0, "")
    assert re.search(r"^gyro .* noise by schedule", out, re.MULTILINE)


def test_run_says_how_many_readings_came_too_late(call):
    late = ("--set", "channels.pole_encoder={latency=0.02, latency_std=0.03}")
    code, out, _ = call("run", "cartpole", *SHORT, *late, "--set", "filter.window=0.03")
    assert code == 0
    note = r"^note: ekf: (\d+) readings came later than filter\.window and were not fused"
    found = re.search(note, out, re.MULTILINE)
    assert found
    assert 0 < int(found[1]) < 4 * 50
    _, out, _ = call("run", "cartpole", *SHORT, *late)
    assert "came later" not in out


@pytest.mark.parametrize(
    ("settings", "note"),
    [
        (["channels.imu.of=['accel', 'gyro']"], "not in use, as `sensors` does not name it: imu"),
        (["channels.position.latency=9.0"],
         "position: its first reading would arrive after the run of 5 s"),
        (["channels.height.rate=0.1"],
         "height: its first reading would arrive after the run of 5 s"),
    ],
)  # fmt: skip
def test_what_is_never_seen_is_said(settings, note, call):
    words = [word for setting in settings for word in ("--set", setting)]
    code, out, err = call("sensors", "quadrotor_delayed", *words)
    assert (code, err) == (0, "")
    assert f"note: {note}\n" in out
    _, out, _ = call("sensors", "quadrotor_delayed")
    assert "note: " not in out


def test_the_picture_of_no_time_is_refused(call):
    code, out, err = call("sensors", "cartpole", "--seconds", "0", "--out", "a.png")
    assert (code, out) == (2, "")
    assert err == "estbench: --seconds is 0; use at least 0.01, one step\n"
