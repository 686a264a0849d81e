import json
import sys

import pytest

from estbench.commands import cli

Q = "filter.process_noise_scale"
SHORT = ("-e", "ekf", "--runs", "4", "--duration", "0.2")


def tune(monkeypatch, *words):
    monkeypatch.setattr(sys, "argv", ["estbench", "tune", "pendulum", *words])
    with pytest.raises(SystemExit) as exit_:
        cli.main()
    return exit_.value.code


def test_a_tuning_prints_and_writes_its_scenario_and_draws(tmp_path, monkeypatch, capsys):
    pytest.importorskip("matplotlib")
    folder, picture = tmp_path / "tuned", tmp_path / "tuned.svg"
    words = (*SHORT, "--free", f"{Q}=0.01:100", "--set", f"{Q}=30", "--out", str(folder),
             "--prior", f"{Q}=1:3", "--held-out", "0")  # fmt: skip
    assert not tune(monkeypatch, *words, "--plot", str(picture))
    out = capsys.readouterr().out
    assert "ekf tuned by likelihood (quasi-newton), 4 runs, seed 0" in out
    assert (folder / "tuned.toml").is_file()
    assert picture.read_text().count("<path") > 10
    assert not tune(monkeypatch, *words, "--resume", "--json")
    assert json.loads(capsys.readouterr().out)["estimator"] == "ekf"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "nothing is free"),
        (("--free", "filter.process_noise_scal"), "unknown key"),
        (("--free", "channels.gyro.noise"), "is not free to vary"),
        (("--free", f"{Q}=2:1"), "the range is empty"),
        (("--free", Q, "--runs", "1"), "1 free parameters need at least 2 runs, got 1"),
        (("--free", Q, "--coordinate", "hinge=0"), "the weight is not above 0"),
        (("--free", Q, "--prior", f"{Q}=1"), "KEY=CENTRE:SPREAD"),
        (("--free", Q, "--plot", "a.gif"), "--format 'gif' is not known"),
    ],
)
def test_bad_input_is_one_line(words, message, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert tune(monkeypatch, *SHORT, *words) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())
