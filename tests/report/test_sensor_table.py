import sys

import pytest

from estbench.commands import cli


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
