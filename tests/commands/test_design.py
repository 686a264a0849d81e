import csv
import io
import json
import sys

import pytest

from estbench.commands import cli

SHORT = ("pendulum", "--duration", "0.3", "--require", "hinge=0.02")


def design(monkeypatch, *words):
    monkeypatch.setattr(sys, "argv", ["estbench", "design", *words])
    with pytest.raises(SystemExit) as exit_:
        cli.main()
    return exit_.value.code


def test_what_it_prints(monkeypatch, capsys):
    assert not design(monkeypatch, *SHORT, "--runs", "5", "-e", "ekf")
    out = capsys.readouterr().out
    assert "σ with all channels and one of them changed" in out
    assert "The suite: encoder; cost 1" in out
    assert "RMSE of the runs" in out
    assert not design(monkeypatch, *SHORT, "--runs", "0", "--format", "csv")
    rows = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert len(rows) == 4
    assert not design(monkeypatch, *SHORT, "--runs", "0", "--format", "json")
    assert json.loads(capsys.readouterr().out)["chosen"] == ["encoder"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("pendulum",), "--require is empty"),
        (("pendulum", "--require", "hinge=1e-9"), "no suite of the channels reaches hinge"),
        ((*SHORT, "--channels", "all,giro"), "'all' matches no channel"),
        ((*SHORT, "--set", "channels.gyro.cost=-1"), "got -1"),
        ((*SHORT, "--coordinate", "x"), "'x' matches none"),
        ((*SHORT, "--format", "xml"), "no format 'xml'"),
    ],
)
def test_bad_input_is_one_line(words, message, monkeypatch, capsys):
    assert design(monkeypatch, *words, "--runs", "0") == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
