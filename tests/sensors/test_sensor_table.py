import sys

import numpy as np
import pytest

from estbench.commands import cli
from estbench.experiment import setup
from estbench.montecarlo import run as experiment
from estbench.report import sensor_table


def prepare(*overrides, name="cartpole_imu"):
    return setup.build(experiment.resolve(name, overrides=overrides))


def words(**section):
    settings = ", ".join(f"{k} = {v}" for k, v in section.items())
    prepared = prepare(f"channels.gyro={{{settings}}}")
    channel = next(c for c in prepared.channels if c.name == "gyro")
    return ", ".join(sensor_table.words(channel))


@pytest.mark.parametrize(
    ("section", "expected"),
    [
        ({}, ""),
        ({"bias": 0.1}, "bias 0.1"),
        ({"bias": "[0.1, 0.2, 0.1]"}, "bias 0.1 0.2"),
        ({"bias_walk": 0.01}, "bias walk 0.01/√s"),
        ({"drift": 0.01, "drift_time": 20}, "drift 0.01 over 20 s"),
        ({"scale_factor": 0.02, "misalignment": 0.01}, "scale factor 2%, misaligned 0.01 rad"),
        ({"student_dof": 5}, "Student-t noise, 5 degrees of freedom"),
        ({"outlier_probability": 0.02}, "2% outliers x 10"),
        ({"cutoff": 3, "quantization": 0.1, "deadband": 0.2},
         "saturates at ± 3, steps of 0.1, deadband 0.2"),
        ({"stuck": 0.01, "stuck_length": 20}, "1% get stuck for 20"),
        ({"dropout": 0.25}, "25% lost"),
        ({"dropout": 0.25, "dropout_length": 4}, "25% lost in gaps of 4"),
        ({"rate": 10, "jitter": 0.02}, "jitter ± 20 ms"),
        ({"schedule": "[[9.0, 2.0]]"}, "noise by schedule"),
        ({"cov": "[[1, 0.5, 0], [0.5, 1, 0], [0, 0, 1]]"}, "correlated noise"),
    ],
)  # fmt: skip
def test_imperfections_in_words(section, expected):
    assert words(**section) == expected


def test_latency_in_words():
    def late(**settings):
        overrides = [f"channels.gyro.{k}={v}" for k, v in settings.items()]
        return sensor_table.latency(prepare(*overrides).channels[-1])

    assert late() == ""
    assert late(latency=0.08) == "80 ms"
    assert late(latency=0.08, latency_std=0.01) == "80 ± 10 ms"


@pytest.fixture
def call(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["estbench", "sensors", *arguments])
        with pytest.raises(SystemExit) as exit_:
            cli.main()
        return exit_.value.code or 0, *capfd.readouterr()

    return run


def test_the_command_shows_a_row_a_channel(call):
    settings = (
        "channels.position.latency_std=0.01", "filter.channels.gyro.noise=0.5",
        "filter.channels.position.latency=0.1", "filter.measurement_noise_scale=2",
    )  # fmt: skip
    code, out, err = call("quadrotor_delayed", *(w for s in settings for w in ("--set", s)))
    assert (code, err) == (0, "")
    lines = {line.split()[0]: line.split() for line in out.splitlines() if line.strip()}
    assert lines["accel"] == ["accel", "accelerometer", "0.1", "m/s²", "200", "Hz", "steps", "of",
                              "0.005"]  # fmt: skip
    assert (
        " ".join(lines["position"]) == "position framepos 0.02 m 10 Hz 80 ± 10 ms white noise only"
    )
    assert " ".join(lines["height"]).endswith("25 Hz 20% lost in gaps of 3")
    assert "the filter believes of gyro: noise σ 0.5" in out
    assert "the filter believes of position: latency 100 ms" in out
    assert "the filter believes R x 2 of every channel" in out
    assert max(len(line) for line in out.splitlines()) <= 100


def test_the_command_refuses_what_run_refuses(call):
    code, out, err = call("quadrotor_delayed", "--set", "channels.gyro.dropout=2")
    assert (code, out) == (2, "")
    assert err.startswith("estbench: quadrotor_delayed: channels.gyro.dropout: Input should be les")
    assert err.endswith("got 2\n")
    code, out, err = call("quadrotor", "--out", "here.txt")
    assert (code, out) == (2, "")
    assert "is no picture; end it in .png, .pdf, .svg" in err


def test_numbers():
    assert sensor_table.numbers(np.array([0.1, 0.1])) == "0.1"
    assert sensor_table.numbers(np.array([0.1, 0.25])) == "0.1 0.25"
