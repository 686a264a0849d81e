"""Simulated runs like a log: like it where the log is one of them, unlike where it is not."""

import csv
import json

import numpy as np
import pytest

from estbench.commands import cli
from estbench.errors import CovarianceError, LogError
from estbench.experiment.recording import estimated
from estbench.logs import likeness_results
from estbench.logs.export import export
from estbench.logs.like import simulated
from estbench.logs.likeness import like
from estbench.logs.prepare import prepare
from estbench.scenario.load import resolve
from estbench.tables import writers


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """A log of the cart-pole of 0.6 s, with a latency and gaps, and the scenario for it."""
    folder = tmp_path_factory.mktemp("like")
    source = folder / "source.toml"
    changes = ["channels.pole_encoder.latency=0.03", "channels.cart_encoder.rate=25"]
    scenario = resolve("cartpole", ["ekf"], runs=1, duration=0.6, overrides=changes)
    source.write_text(scenario.to_toml(), encoding="utf-8")
    (file,) = export(source, folder / "logs")
    return folder / "logs" / "scenario.toml", file


def test_the_filter_is_consistent_on_what_it_believes(logs):
    """The sum of NIS of 30 runs is chi-square: outside of 4.5 σ with probability 10^-5."""
    scenario, file = logs
    prepared, log = prepare(resolve(scenario, ["ekf"]), [file])
    truth = simulated(prepared, "ekf", log, range(30))
    traces, _ = estimated(prepared, "ekf", range(30), truth)
    assert not traces.fault.any()
    count = traces.dof.sum()
    assert abs(np.nansum(traces.nis) - count) < 4.5 * np.sqrt(2 * count)
    # The readings come when those of the log did, late where they were late.
    arrivals = [len(d) for d in truth.deliveries]
    assert sum(arrivals) == sum(len(part.y) for part in log.channels)
    late = [d for k, d in enumerate(truth.deliveries) for d in d if d.taken < log.instants[k].tick]
    assert {d.channels for d in late} == {("pole_encoder",)}
    assert np.array_equal(truth.u[:, 3], log.u)
    again = simulated(prepared, "ekf", log, range(3, 5))
    assert np.array_equal(again.x, truth.x[:, 3:5])  # a run does not depend on the others


def test_a_run_is_like_the_others_and_another_robot_is_not(logs, tmp_path):
    scenario, file = logs
    same = like(scenario, file, ["ekf"], runs=19).found[0]
    # Each is outside with probability 10%; 28 are correlated, and more than 12 are not seen.
    assert len(same.traits) > 20
    assert len(same.differing) <= 12
    with file.open(newline="") as given:
        rows = list(csv.DictReader(given))
    for row in rows:
        if row["pole_encoder"]:
            row["pole_encoder"] = repr(round(float(row["pole_encoder"]) / 0.05) * 0.05)
    coarse = tmp_path / "coarse.csv"
    with coarse.open("w", newline="") as out:
        writer = csv.DictWriter(out, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    other = like(scenario, coarse, ["ekf"], runs=19)
    names = {(t.component, t.name) for t in other.found[0].differing}
    assert ("pole_encoder", "unchanged readings") in names
    assert ("all", "NIS/m") in names
    text = writers.printed(likeness_results.render(other), width=100)
    chance = "are outside of all 19 runs; by chance each is with probability 10.0%"
    assert chance in " ".join(text.split())
    plain = json.loads(likeness_results.to_json(other))["estimators"]["ekf"]
    assert len(plain["spectra"]) == 2


def test_steps_of_an_encoder_are_a_part_of_its_noise(logs):
    scenario, file = logs
    step = ["channels.pole_encoder.quantization=0.01"]
    enough = [*step, "filter.channels.pole_encoder.noise=0.003"]
    prepared, log = prepare(resolve(scenario, ["ekf"], overrides=enough), [file])
    made = simulated(prepared, "ekf", log, range(2)).deliveries
    y = np.concatenate([d.y for some in made for d in some if d.channels == ("pole_encoder",)])
    assert np.array_equal(y, 0.01 * np.round(y / 0.01))
    few = [*step, "filter.channels.pole_encoder.noise=0.002"]
    prepared, log = prepare(resolve(scenario, ["ekf"], overrides=few), [file])
    with pytest.raises(CovarianceError, match=r"less than a step of 0\.01 over √12"):
        simulated(prepared, "ekf", log, range(2))


def test_the_command_draws_and_refuses(logs, tmp_path, monkeypatch, capsys):
    pytest.importorskip("matplotlib")
    scenario, file = logs
    picture = tmp_path / "spectra.svg"

    def typed(*words):
        monkeypatch.setattr("sys.argv", ["estbench", "run", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        return ended.value.code or 0, capsys.readouterr()

    code, out = typed(scenario, "--like", file, "-e", "ekf", "--runs", 3, "--plot", picture,
                      "--hold-out", "cart_encoder")  # fmt: skip
    assert (code, "cartpole like run_0.csv" in out.out) == (0, True)
    assert picture.read_text().count("<path") > 5
    code, out = typed("cartpole", "--plot", picture)
    assert (code, out.err.count("\n"), "needs --like LOG" in out.err) == (2, 1, True)
    with pytest.raises(LogError, match="simulate at least 2 runs"):
        like(scenario, file, runs=1)
