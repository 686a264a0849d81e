"""Bad logs are one line each, with file, row and time; nothing is written."""

import re

import numpy as np
import pytest

from estbench.commands import cli
from estbench.logs.export import export
from estbench.scenario.load import resolve


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A pendulum's log of 0.3 s as lines of text, and the scenario that replays it."""
    folder = tmp_path_factory.mktemp("bad")
    scenario = resolve("pendulum", ["ekf"], runs=1, duration=0.3)
    (folder / "scenario.toml").write_text(scenario.to_toml(), encoding="utf-8")
    (file,) = export(folder / "scenario.toml", folder / "logs")
    return file.read_text().splitlines(), folder / "logs" / "scenario.toml"


def without(lines, column, rows):
    """The lines with a cell of some rows left empty."""
    place = lines[0].split(",").index(column)
    out = [line.split(",") for line in lines]
    for row in rows:
        out[row][place] = ""
    return [",".join(cells) for cells in out]


CASES = {
    "empty": (lambda s: [], "is empty"),
    "headings alone": (lambda s: s[:1], "is empty: it has headings"),
    "cut off": (lambda s: [*s[:-1], s[-1][:9]], r"row 32 has \d+ cells; .*is it cut off"),
    "a column is missing": (
        lambda s: [s[0].replace("gyro.1", "gyro.7"), *s[1:]], "no column 'gyro.1'.*gyro.",
    ),
    "twice": (lambda s: [s[0].replace("gyro.1", "gyro.2"), *s[1:]], "two columns 'gyro.2'"),
    "text": (lambda s: [*s[:4], s[4].replace(s[4].split(",")[1], "off", 1), *s[5:]],
             "row 5: column 'encoder' has 'off'"),
    "backwards": (lambda s: [*s[:9], s[4], *s[9:]], r"row 10, t = 0\.03 s: the time stamp goes "
                  r"back by 0\.04 s"),
    "no time": (lambda s: without(s, "time", [6]), "row 7: the time stamp in column 'time'"),
    "a control is missing": (lambda s: without(s, "u.torque", [6]),
                             r"row 7, t = 0\.05 s: the control in column 'u.torque' is missing"),
    "controls end": (lambda s: without(s, "u.torque", range(2, 32)),
                     r"row 2, t = 0 s: the controls end here and the readings go on to t = 0\.3 s"),
    "no reading": (lambda s: without(s, "encoder", range(1, 32)),
                   "has no reading of channel 'encoder'"),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_one_line_and_nothing_written(exported, tmp_path, monkeypatch, capsys, name):
    lines, scenario = exported
    change, message = CASES[name]
    log, out = tmp_path / "log.csv", tmp_path / "out"
    log.write_text("\n".join(change(list(lines))) + "\n", encoding="utf-8")
    monkeypatch.setattr(
        "sys.argv", ["estbench", "replay", str(scenario), str(log), "--out", str(out)]
    )
    with pytest.raises(SystemExit) as ended:
        cli.main()
    printed = capsys.readouterr()
    assert ended.value.code == 2
    (line,) = printed.err.strip().splitlines()
    assert not printed.out
    assert re.search(message, line), line
    assert not out.exists()
    assert list(tmp_path.iterdir()) == [log]


def test_missing_readings_are_counted(exported, tmp_path):
    from estbench.logs.replay import replay

    lines, scenario = exported
    log = tmp_path / "log.csv"
    log.write_text("\n".join(without(lines, "encoder", [5, 6, 7])) + "\n", encoding="utf-8")
    found = replay(scenario, log)
    encoder = next(part for part in found.log.channels if part.name == "encoder")
    assert encoder.missing == 4  # the three, and none at the start
    assert np.isfinite(found["ekf"].traces.mean).all()
