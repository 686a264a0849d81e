import csv
import io
import json
import sys

import pytest

from estbench.commands import cli

SHORT = ("pendulum", "-e", "ekf", "--duration", "0.1")


def budget(monkeypatch, *words):
    monkeypatch.setattr(sys, "argv", ["estbench", "budget", *words])
    with pytest.raises(SystemExit) as exit_:
        cli.main()
    return exit_.value.code


def test_what_it_prints_and_draws(tmp_path, monkeypatch, capsys):
    plot = tmp_path / "budget.svg"
    words = (*SHORT, "--over-time", "--plot", str(plot), "--coordinate", "hinge")
    assert not budget(monkeypatch, *words)
    out = capsys.readouterr().out
    assert "error budget by linear covariance analysis" in out
    assert "the filter believes" in out
    assert "σ of hinge [rad] over time" in out
    assert "hinge.vel" not in out
    assert plot.read_text().count("initial") >= 1
    assert not budget(monkeypatch, *SHORT, "--format", "csv", "--by-source")
    rows = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert {row["source"] for row in rows} == {
        "initial.hinge", "initial.hinge.vel", "process.hinge.vel", "encoder.noise", "gyro.noise"
    }  # fmt: skip
    shares = [float(row["share"]) for row in rows if row["coordinate"] == "hinge"]
    assert sum(shares) == pytest.approx(1.0)
    monte_carlo = ("--monte-carlo", "--runs", "3", "--workers", "1")
    assert not budget(monkeypatch, *SHORT, *monte_carlo, "--format", "json")
    found = json.loads(capsys.readouterr().out)
    assert found["dimensions"]["alone"] == ["source", "coordinate"]
    assert len(found["values"]["rest"]) == 2


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("pendulum", "-e", "pf"), "ParticleFilter shows no gain on the readings"),
        (("pendulum", "-e", "kf"), "linearizes at a fixed or nominal state"),
        (("pendulum", "-e", "rts"), "looks back"),
        ((*SHORT, "--coordinate", "hing"), "'hing' matches none (did you mean 'hinge'"),
        ((*SHORT, "--format", "xml"), "no format 'xml'"),
        ((*SHORT, "--plot", "a.gif"), "--format 'gif' is not known"),
        ((*SHORT, "--monte-carlo", "--runs", "1"), "--runs is 1, which gives no intervals"),
        ((*SHORT, "--set", 'start.method="batch"', "--set", "start.window=0.05"),
         "the fit of the first readings (start.method) has no gain"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line(words, message, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert budget(monkeypatch, *words, "--duration", "0.1") == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())
