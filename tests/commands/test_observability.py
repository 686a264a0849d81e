import csv
import io
import json
import sys

import pytest

from estbench.commands import cli

SHORT = ("pendulum", "--window", "0.2")


def observability(monkeypatch, *words):
    monkeypatch.setattr(sys, "argv", ["estbench", "observability", *words])
    with pytest.raises(SystemExit) as exit_:
        cli.main()
    return exit_.value.code


def test_what_it_prints(monkeypatch, capsys):
    gyro = ("--set", 'sensors=["gyro"]', "--set", "channels.gyro.bias=0.05")
    assert not observability(monkeypatch, *SHORT, *gyro)
    out = capsys.readouterr().out
    assert "pendulum: what the sensors see in 0.2 s" in out
    assert "bias.gyro" in out
    assert "never" in out
    assert not observability(monkeypatch, *SHORT, *gyro, "--format", "csv", "--no-motions")
    rows = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert any(row["seen_from"] == "" and float(row["left"]) > 0.7 for row in rows)
    assert not observability(monkeypatch, *SHORT, "--format", "json")
    found = json.loads(capsys.readouterr().out)
    assert [c["name"] for c in found["coordinates"]] == ["hinge", "hinge.vel"]
    assert len(found["eigenvalues"]) == 2


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("pendulum", "--run", "-1"), "--run is -1"),
        (("pendulum", "--window", "0"), "duration"),
        ((*SHORT, "--set", "initial.std=0.0"), "there is nothing to observe"),
        ((*SHORT, "--format", "xml"), "no format 'xml'"),
        (("pendulums",), "no scenario 'pendulums' (did you mean 'pendulum'"),
    ],
)
def test_bad_input_is_one_line(words, message, monkeypatch, capsys):
    assert observability(monkeypatch, *words) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
