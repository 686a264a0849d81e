"""Replay of logs: the numbers of the run that they are from, time as it is, and bad input."""

import csv

import numpy as np
import pytest

from estbench.commands import cli
from estbench.consistency.verdict import Verdict
from estbench.errors import LogError
from estbench.experiment.recording import followed, recorded
from estbench.experiment.setup import build
from estbench.logs.export import export
from estbench.logs.replay import replay
from estbench.logs.results import render, to_dict
from estbench.scenario.load import resolve
from estbench.simulation.sources import Recorded
from estbench.tables import writers

LATE = ["channels.pole_encoder.latency=0.03", "channels.cart_encoder.rate=25",
        "channels.pole_encoder.dropout=0.2"]  # fmt: skip


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A pendulum's log of 3 s: the file of its run, and the scenario that replays it."""
    folder = tmp_path_factory.mktemp("logs") / "out"
    scenario = resolve("pendulum", ["ekf"], runs=1, duration=3.0)
    source = folder.parent / "scenario.toml"
    source.write_text(scenario.to_toml(), encoding="utf-8")
    (file,) = export(source, folder)
    return file, folder / "scenario.toml"


def rewritten(path, file, change):
    """A copy of a log whose rows (dictionaries) went through a function."""
    with file.open(newline="") as given:
        rows = change(list(csv.DictReader(given)))
    with path.open("w", newline="") as out:
        writer = csv.DictWriter(out, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    return path


@pytest.mark.parametrize(("name", "changes"), [("pendulum", []), ("cartpole", LATE)])
def test_a_replayed_run_has_the_numbers_of_the_run(tmp_path, name, changes):
    scenario = resolve(name, ["ekf"], runs=3, duration=0.6, overrides=changes)
    source = tmp_path / "scenario.toml"
    source.write_text(scenario.to_toml(), encoding="utf-8")
    files = export(source, tmp_path / "logs", [0, 2])
    prepared = build(scenario)
    found = recorded(prepared, range(3))
    assert found is not None
    run = followed(prepared, "ekf", range(3), Recorded(prepared.instants, found[0]))
    assert run is not None
    for number, file in zip((0, 2), files):
        log = replay(tmp_path / "logs" / "scenario.toml", file)["ekf"].traces
        fields = ("mean", "std", "nis", "log_likelihood", "channel_nis", "error", "nees", "rank",
                  "truth", "along")  # fmt: skip
        for field in fields:
            expected = getattr(run, field)[:, [number]]
            assert np.array_equal(getattr(log, field), expected, equal_nan=True), field
        # Sums over the steps, in another order.
        assert log.lags == pytest.approx(run.lags[[number]], rel=1e-12)


def test_the_verdict_of_the_innovations(exported):
    file, scenario = exported
    right = replay(scenario, file)
    assert right["ekf"].innovations.nis.low < 1 < right["ekf"].innovations.nis.high
    wrong = replay(scenario, file, overrides=["filter.measurement_noise_scale=0.1"])["ekf"]
    assert wrong.innovations.verdict is Verdict.OVERCONFIDENT
    assert "NIS/m" in wrong.innovations.reason
    assert "verdict" in writers.printed(render(right), width=100)
    plain = to_dict(right)["estimators"]["ekf"]
    assert plain["log_likelihood"] == right["ekf"].log_likelihood
    assert plain["rmse"]["hinge"]["value"] == right["ekf"].summary.rmse[0].value


def test_a_channel_that_is_held_out_is_predicted(exported):
    file, scenario = exported
    (found,) = replay(scenario, file, hold_out=["encoder"]).replayed
    (prediction,) = found.predictions
    assert len(prediction.error) == 300
    assert found.traces.dof.max() == 3  # the gyro alone
    # Its own noise counts: σ is not below the encoder's 0.01 rad, and the ratio is near 1.
    assert (prediction.std > 0.01).all()
    assert 0.5 < prediction.ratio.mean() < 2.0


def test_rows_out_of_order_are_fused_within_the_window(exported, tmp_path):
    file, scenario = exported

    def swap(rows):
        rows[10], rows[11] = rows[11], rows[10]
        return rows

    log = rewritten(tmp_path / "log.csv", file, swap)
    with pytest.raises(LogError, match=r"row 13, t = 0\.1 s: the time stamp goes back by 0\.01 s"):
        replay(scenario, log)
    late = replay(scenario, log, overrides=["filter.window=0.05"])["ekf"].traces
    whole = replay(scenario, file)["ekf"].traces
    assert late.late.sum() == 0
    assert np.array_equal(late.mean[-1], whole.mean[-1])
    assert np.array_equal(late.nis, whole.nis, equal_nan=True)
    assert not np.array_equal(late.mean[10], whole.mean[10])  # it had not come yet


def test_gaps_equal_stamps_and_odd_intervals(exported, tmp_path):
    file, scenario = exported

    def change(rows):
        for row in rows[20:60]:
            row |= dict.fromkeys(("encoder", "gyro.0", "gyro.1", "gyro.2"), "")
        rows.insert(5, dict(rows[5]))  # equal stamps: both are fused
        for i in range(8, 16):
            rows[i]["time"] = repr(float(rows[i]["time"]) + 0.0013 * (i % 3))
        return rows

    log = rewritten(tmp_path / "log.csv", file, change)
    once, again = (replay(scenario, log, ["ekf", "ukf"]) for _ in range(2))
    for label in ("ekf", "ukf"):
        traces = once[label].traces
        assert not traces.fault.any()
        assert np.array_equal(traces.mean, again[label].traces.mean)
        assert traces.dof[:, 0].max() == 8
        assert np.nanmean(traces.nis / traces.dof) < 2.0
        std = traces.std[:, 0, 0]
        assert std[59] > 1.3 * std[19]  # nothing arrives for 0.4 s
        assert np.isnan(traces.nis[30, 0])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("log.channels.gyro.columns=['encoder','gyro.0','gyro.1']", "'encoder' is mapped to"),
        ("log.channels.encoder.columns=['encoders']", r"no column 'encoders'.*'encoder'"),
        ("log.channels.encoder.unit=furlong", "unit is 'furlong'"),
        ("log.channels.gyro.columns=['gyro.0']", "has 1 columns; the channel has 3"),
        ("log.controls.brake.columns=['u.torque']", "no actuator 'brake'"),
        ("log.skip=99", "has no reading from t = 99"),
        ("log.time=clock", "no column 'clock'"),
    ],
)
def test_mistakes_of_the_section_are_one_line(exported, text, message):
    file, scenario = exported
    with pytest.raises(LogError, match=message):
        replay(scenario, file, overrides=[text])


def test_missing_cells(exported, tmp_path):
    file, scenario = exported

    def without(column):
        def change(rows):
            rows[7][column] = ""
            return rows

        return rewritten(tmp_path / f"{column}.csv", file, change)

    found = replay(scenario, without("encoder"))
    assert found["ekf"].traces.dof[6, 0] == 3
    with pytest.raises(LogError, match=r"row 9, t = 0\.07 s: the control in column 'u\.torque'"):
        replay(scenario, without("u.torque"))
    with pytest.raises(LogError, match="row 9: the time stamp in column 'time' is missing"):
        replay(scenario, without("time"))


def test_degrees_are_suspected_and_converted(exported, tmp_path):
    file, scenario = exported

    def degrees(rows):
        for row in rows:
            if row["encoder"]:
                row["encoder"] = str(90.0 + np.degrees(float(row["encoder"])))
        return rows

    log = rewritten(tmp_path / "log.csv", file, degrees)
    assert "if it is deg" in replay(scenario, log).log.notices[0]
    keys = [f"log.channels.encoder.{k}" for k in ('unit="deg"', f"offset={-np.pi / 2!r}")]
    right = replay(scenario, log, overrides=keys)
    assert not right.log.notices
    assert right["ekf"].traces.mean == pytest.approx(replay(scenario, file)["ekf"].traces.mean)


def test_the_commands(exported, tmp_path, monkeypatch, capsys):
    file, scenario = exported
    monkeypatch.chdir(tmp_path)  # the default folder of the results is in it

    def typed(*words):
        monkeypatch.setattr("sys.argv", ["estbench", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        return ended.value.code, capsys.readouterr()

    code, out = typed("replay", scenario, file, "--hold-out", "gyro", "--json")
    assert (code or 0, '"predicted"' in out.out) == (0, True)
    code, out = typed("replay", "--inspect", file)
    assert (code or 0, "302 rows" in out.out or "301 rows" in out.out) == (0, True)
    for words in (
        ("replay", scenario),
        ("replay", "pendulum", file),
        ("replay", scenario, file, "--hold-out", "compass"),
        ("replay", scenario, tmp_path / "none.csv"),
        ("export", scenario, "--out", scenario.parent),
    ):
        code, out = typed(*words)
        assert code == 2
        assert len(out.err.strip().splitlines()) == 1
