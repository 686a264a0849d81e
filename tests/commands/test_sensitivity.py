import csv
import io
import json
import sys

import pytest

from estbench.commands import cli

SHORT = ("pendulum", "-e", "ekf", "--duration", "0.1", "--runs", "3", "--workers", "1")


def sensitivity(monkeypatch, *words):
    monkeypatch.setattr(sys, "argv", ["estbench", "sensitivity", *words])
    with pytest.raises(SystemExit) as exit_:
        cli.main()
    return exit_.value.code


def test_what_it_prints_and_draws(tmp_path, monkeypatch, capsys):
    plot = tmp_path / "tornado.svg"
    words = (*SHORT, "--key", "*gyro.noise", "--key", "filter.set.dof*", "--plot", str(plot))
    assert not sensitivity(monkeypatch, *words, "--coordinate", "hinge", "--curves", "1")
    out = capsys.readouterr().out
    assert "pendulum, ekf: sensitivity" in out
    assert "Over a wide range" in out
    assert "RMSE hinge" in out
    assert "0.05 rad/s" in out
    assert max(map(len, out.splitlines())) <= 100
    assert plot.read_text().count("<path") > 20
    assert not sensitivity(monkeypatch, *words[:-2], "--format", "csv")
    rows = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert {row["parameter"]: row["side"] for row in rows} == {
        "filter.channels.gyro.noise": "filter", "channels.gyro.noise": "hardware",
        "filter.set.dof_damping.hinge": "filter",
    }  # fmt: skip
    assert all(float(row["rmse_low"]) < float(row["rmse_high"]) for row in rows)
    ranged = ("--key", "channels.*.noise=log:0.01:0.1", "--sobol", "2", "--format", "json")
    assert not sensitivity(monkeypatch, *SHORT, *ranged)
    found = json.loads(capsys.readouterr().out)
    assert found["dimensions"]["total"] == ["output", "indexed"]
    assert not sensitivity(monkeypatch, *SHORT, *ranged[:-2])
    assert "0.01 to 0.1 rad" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--key", "channels.gyr.noise"), "matches no parameter (did you mean 'channels.gyro"),
        (("--key", "damping"), "matches no parameter; use a pattern, '*damping*'"),
        (("--key", "simulation.duration"), "is not of the filter or the hardware"),
        (("--key", "start.offset"), "is 0, which has no relative change; give a range"),
        (("--key", "channels.gyro.noise=1,2"), "use channels.gyro.noise=lin:LOW:HIGH"),
        (("--key", "initial.std=log:0.1:1"), "several numbers, which vary by one factor"),
        (("--step", "1.5"), "--step is 1.5; use a relative change between 0 and 1"),
        (("--runs", "1"), "--runs is 1, which gives no intervals"),
        (("--sobol", "7"), "--sobol is 7; use a power of two"),
        (("--spread", "1", "--sobol", "8"), "--spread is 1; use a factor above 1"),
        (("--curves", "-1"), "--curves is -1; use a count of at least 0"),
        (("--ranges", "--key", "start.inflate"), "the verdict is undecided as the scenario is"),
        (("--plot", "a.gif"), "--format 'gif' is not known"),
        (("--format", "xml"), "no format 'xml'"),
        (("--coordinate", "hing"), "'hing' matches none"),
        (("-e", "ekff"), "ekff"),
    ],
)
def test_bad_input_is_one_line(words, message, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert sensitivity(monkeypatch, *SHORT, *words) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())
