import sys

import pytest

from estbench import open_study
from estbench.commands import cli


def sweep(monkeypatch, *words):
    monkeypatch.setattr(sys, "argv", ["estbench", "sweep", "pendulum", *words])
    with pytest.raises(SystemExit) as exit_:
        cli.main()
    return exit_.value.code


SHORT = ("-e", "ekf", "--runs", "4", "--duration", "0.2")


def test_a_sweep_prints_a_table_and_writes_its_store(tmp_path, monkeypatch, capsys):
    folder = tmp_path / "swept"
    words = (*SHORT, "--over", "filter.process_noise_scale=0.1,10", "--out", str(folder))
    assert not sweep(monkeypatch, *words)
    out = capsys.readouterr().out
    assert "2 variants x 4 runs x 0.2 s, seed 0; truth simulated for 1 of them" in out
    assert out.count("ekf") >= 2
    assert open_study(folder).sizes["filter.process_noise_scale"] == 2
    assert not sweep(monkeypatch, *words, "--resume")
    assert sweep(monkeypatch, *words) == 2
    assert "exists; choose another --out" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "name one with --over KEY=SPEC"),
        (("--over", "filter.process_noise_scal=1,2"), "unknown key (did you mean"),
        (("--over", "filter.window=lin:2:1:3"), "the range from 2 to 1 is empty"),
        (("--over", "start.inflate=1,2", "--plot", "a.gif"), "--format 'gif' is not known"),
        (("--over", "start.inflate=1,2", "--plot", "a.png", "--what", "anes"), "is not known"),
        (("--over", "start.inflate=1,2", "--shard", "2"), "use I/N"),
    ],
)
def test_bad_input_is_one_line(words, message, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert sweep(monkeypatch, *SHORT, *words) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())
