"""Tuning on logs: what simulated logs are known to have, judged on a log that was not seen."""

import json
import sys

import numpy as np
import pytest

from estbench import tune
from estbench.commands import cli
from estbench.errors import StudyError
from estbench.logs.export import export
from estbench.logs.replay import replay
from estbench.scenario.load import resolve

R, OFFSET = "filter.measurement_noise_scale", "log.channels.encoder.offset"
SHIFT = 0.02
"""Error of the encoder, rad: 2 of its standard deviations."""


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Two logs of 0.6 s, whose section `[log]` says an offset that the encoder has not."""
    folder = tmp_path_factory.mktemp("logs")
    source = folder / "source.toml"
    scenario = resolve("pendulum", ["ekf"], runs=2, duration=0.6)
    source.write_text(scenario.to_toml(), encoding="utf-8")
    files = export(source, folder / "logs")
    wrong = resolve(folder / "logs" / "scenario.toml", overrides=[f"{OFFSET}={SHIFT}", f"{R}=9"])
    return wrong, files


@pytest.fixture(scope="module")
def tuned(logs, tmp_path_factory):
    scenario, (first, second) = logs
    folder = tmp_path_factory.mktemp("tuned") / "out"
    return tune(
        scenario, "ekf", [R, f"{OFFSET}=-0.1:0.1"], logs=[first], held_out_logs=[second],
        hold_out=["gyro"], out=folder, iterations=4,
    )  # fmt: skip


def test_the_values_are_those_of_the_log(tuned):
    """Each error is below 4.5 standard errors, which fails for 1 of 10^5 logs; this log is one."""
    true = {R: 0.0, OFFSET: 0.5}  # in the coordinate of the search: ln R, share of the range
    for parameter, x, std in zip(tuned.parameters, tuned.point, tuned.uncertainty.std):
        assert abs(x - true[parameter.key]) < 4.5 * std
    assert tuned.logs == ("run_0.csv",)
    assert tuned.runs == 6  # blocks of 10 updates


def test_it_is_judged_on_the_other_log(logs, tuned):
    _, files = logs
    own, other = tuned.held_out.pairs
    assert (own.held_out, other.held_out) == (False, True)
    assert other.change.low > 0
    assert abs(other.after.predictions[0].ratio.mean() - 1) < 0.5
    text = str(tuned)
    assert "on run_0.csv in 6 blocks of time" in text
    assert "held out  after" in text
    # The scenario that was written gives the numbers of the table.
    again = replay(tuned.folder / "tuned.toml", files[1], ["ekf"], hold_out=["gyro"])["ekf"]
    assert np.array_equal(again.traces.nis, other.after.traces.nis, equal_nan=True)
    plain = json.loads(tuned.to_json())["held_out"]["run_1.csv"]
    assert plain["after"]["nis_over_m"]["value"] == again.innovations.nis.value


def test_the_latency_of_a_channel_is_found(logs, tmp_path):
    """An encoder whose readings are stamped two periods late; bounds of 4.5 standard errors."""
    scenario, (file, _) = logs
    rows = [line.split(",") for line in file.read_text(encoding="utf-8").splitlines()]
    column = rows[0].index("encoder")
    values = [row[column] for row in rows[1:]]
    for row, value in zip(rows[1:], ["", "", *values[:-2]]):
        row[column] = value
    late = tmp_path / "late.csv"
    late.write_text("\n".join(map(",".join, rows)), encoding="utf-8")
    key, matched = "log.channels.encoder.latency", [f"{OFFSET}=0", f"{R}=1"]
    tuned = tune(scenario, "ekf", [f"{key}=0:0.05"], logs=[late], overrides=matched, iterations=3)
    std = 0.05 * tuned.uncertainty.std[0]  # that of the search is in shares of the range
    assert abs(tuned[key] - 0.02) < 4.5 * std < 0.02


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--free", R, "--runs", "3"), "--runs is 3, which simulated runs have"),
        (("--free", "log.channels.encoder.scale"), "is not free to vary; of [log] these are"),
        (("--free", OFFSET), "which gives no range"),
        (("--free", R, "--objective", "mse"), "needs the true state"),
        (("--free", R, "--held-out-log", "{file}"), "run_0.csv is tuned on and held out"),
        (("--free", R, "--hold-out", "gyros"), "[log] has no such channel"),
    ],
)
def test_bad_input_is_one_line(logs, words, message, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    _, (file, _) = logs
    path = file.parent / "scenario.toml"
    given = [word.replace("{file}", str(file)) for word in words]
    words = ["tune", str(path), "-e", "ekf", "--log", str(file), *given]
    monkeypatch.setattr(sys, "argv", ["estbench", *words])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    error = capsys.readouterr().err
    assert (ended.value.code, message in error, error.count("\n")) == (2, True, 1), error
    assert not list(tmp_path.iterdir())


def test_a_log_is_needed(logs):
    scenario, (file, _) = logs
    with pytest.raises(StudyError, match="needs a log to tune on"):
        tune(scenario, "ekf", [R], held_out_logs=[file])
    with pytest.raises(StudyError, match="is for logs"):
        tune(scenario, "ekf", [R], hold_out=["gyro"])
