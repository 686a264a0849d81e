import csv
import io
import json
import re
import sys

import numpy as np
import pytest

import estbench
from estbench.analysis import findings, formats, load
from estbench.analysis.compare import compare_stores
from estbench.analysis.comparison import paired
from estbench.commands import cli
from estbench.consistency import intervals
from estbench.errors import AnalysisError, StoreError
from estbench.inference.lags import LAGS
from estbench.tables.formats import FORMATS


@pytest.fixture(scope="module")
def both(stores):
    return compare_stores([stores["a"].folder, stores["b"].folder])


# What is compared with what


def test_a_folder_of_results_stands_for_those_in_it(stores, tmp_path):
    for name in ("b", "seed"):
        (tmp_path / name).symlink_to(stores[name].folder)
    (tmp_path / "notes").mkdir()
    comparison = compare_stores([tmp_path])
    assert [c.title[-6:] for c in comparison.contests] == ["seed 0", "seed 1"]
    with pytest.raises(StoreError, match="holds no data"):
        compare_stores([tmp_path / "notes"])


def test_the_ranking_says_who_is_not_consistent_and_why_there_is_no_nci(both):
    text = formats.render(both, "text")
    ranking = text[text.index("Ranking by RMSE") :]
    assert re.search(r"7 +b/ekf +(?!consistent)[a-z]+ ", ranking)
    assert "NCI of b/ekf is –: the errors of each run are not stored" in text


def test_one_store(stores):
    comparison = compare_stores([stores["a"].folder])
    (contest,) = comparison.contests
    assert [f.key for f in contest.findings] == ["ekf", "ukf", "kf", "ckf", "iekf", "sr_ekf"]
    assert len(contest.pairs) == 15
    assert contest.title == "cartpole: 24 runs x 0.2 s (20 instants), seed 0"
    assert [(r.place, r.last, r.tied) for r in contest.ranks] == [(1, 6, True)] * 6


def test_stores_of_one_scenario_and_seed_are_paired(both, stores):
    (contest,) = both.contests
    keys = [f.key for f in contest.findings]
    assert keys[0] == "a/ekf"
    assert keys[-1] == "b/ekf"
    # A filter told 300 times Q is worse than all six others, which tie.
    assert [r.place for r in contest.ranks] == [1] * 6 + [7]
    last = contest.ranks[-1]
    assert (last.key, last.last, last.tied) == ("b/ekf", 7, False)
    a, b = (stores[k].records["ekf"]["mse"] for k in "ab")
    mean_log = 0.5 * (np.log(b) - np.log(a)).mean()
    ratio = {(p.a, p.b): p.ratio.value for p in contest.pairs}["a/ekf", "b/ekf"]
    assert ratio == pytest.approx(np.exp(-mean_log))


def test_another_seed_is_another_contest(stores):
    comparison = compare_stores([stores[k].folder for k in ("b", "seed")])
    assert [len(c.findings) for c in comparison.contests] == [1, 1]
    assert [c.title[-6:] for c in comparison.contests] == ["seed 0", "seed 1"]


def test_runs_that_one_store_lacks_are_left_out_of_the_pairs(stores, unfinished):
    (contest,) = compare_stores([stores["b"].folder, unfinished]).contests
    np.testing.assert_array_equal(contest.runs, np.r_[0:8, 16:24])
    by = {f.key: f.summary.runs for f in contest.findings}
    assert by["b/ekf"] == 24
    assert by["unfinished/ekf"] == 16
    assert {p.paired.runs for p in contest.pairs} == {16}
    text = formats.render(compare_stores([stores["b"].folder, unfinished]), "text")
    assert f"[unfinished: {unfinished} has 16 of 24 runs]" in " ".join(text.split("\n"))[:200]


def test_details_are_the_pairs_of_every_coordinate(both, stores):
    (contest,) = both.contests
    details = dict(zip([(p.a, p.b) for p in contest.pairs], contest.details()))
    rmse, nees = details["a/ekf", "b/ekf"]
    a, b = (stores[k].records["ekf"] for k in "ab")
    for i in range(4):
        assert rmse[i] == paired(np.sqrt(a["mse"][:, i]), np.sqrt(b["mse"][:, i]))
    assert nees.difference.value == pytest.approx((a["anees"] - b["anees"]).mean())
    index = [(p.a, p.b) for p in contest.pairs].index(("a/ekf", "b/ekf"))
    assert contest.nees[index].value == pytest.approx(nees.difference.value)


def test_what_cannot_be_compared(stores, tmp_path):
    a = stores["a"].folder
    with pytest.raises(StoreError, match="read stores of one robot together"):
        compare_stores([a, stores["pendulum"].folder])
    with pytest.raises(StoreError, match="named twice"):
        compare_stores([a, a.parent / "b" / ".." / "a"])
    for name in ("margin", "precision"):
        for value in (0.0, 1.0, -1.0, np.nan):
            with pytest.raises(AnalysisError, match=f"{name} is .*; use a number between"):
                compare_stores([a], **{name: value})


# What is found


def test_findings_of_an_estimator(both):
    f = both.contests[0].findings[0]
    record = f.record
    assert [a.unit for a in f.accuracy] == ["m", "rad", "m/s", "rad/s"]
    for i, a in enumerate(f.accuracy):
        mse = record["mse"][:, i]
        assert a.names == (f.stored.names[i],)
        assert a.mean.value == pytest.approx(np.sqrt(mse.mean()))
        assert (a.mean.low, a.mean.high) == (f.summary.rmse[i].low, f.summary.rmse[i].high)
        assert a.median.value == pytest.approx(np.sqrt(np.median(mse)))
        assert a.trimmed.value == pytest.approx(np.sqrt(np.sort(mse)[2:-2].mean()))
        assert a.sigma == pytest.approx(np.sqrt(record["variance"][:, i].mean()))
        assert a.needed == intervals.runs_needed(mse, 0.04 * mse.mean())
        assert a.coverage is not None
        assert f.coverage is not None
        assert a.coverage == f.coverage[i]
        assert a.coverage.shares[1].value == pytest.approx(record["inside_2"][:, i].mean())
    assert f.nci is not None
    assert 0.3 < f.nci < 3
    assert both.contests[0].findings[-1].nci is None  # no traces
    assert f.anees_needed == intervals.runs_needed(record["anees"], 0.02)


def test_coordinates_of_one_unit_are_one_norm(stores):
    record = stores["a"].records["ekf"]
    (first, _) = findings.accuracies(record, tuple("abcd"), ("m", "m", "m", "rad"), 0.95, 0.02)
    assert first.names == ("a", "b", "c")
    assert first.mean.value == pytest.approx(np.sqrt(record["mse"][:, :3].sum(axis=1).mean()))


def test_lag_products_are_read_where_there_are_any(stores):
    stored = load.load(stores["a"].folder)
    found = findings.find(stored, "ekf", "ekf", 0.02).whiteness
    assert found is not None
    assert found.rejected.value < 0.3
    assert len(found.correlation) == LAGS
    white = findings.find(load.load(stores["b"].folder), "ekf", "ekf", 0.02).whiteness
    assert white is not None
    assert white.p < 1e-4 < found.p  # a filter told 300 times the process noise, over 20 steps
    del stored.records["ekf"]["lags"]  # as in a store of an older version
    assert findings.find(stored, "ekf", "ekf", 0.02).whiteness is None


def test_every_run_diverged(stores):
    stored = load.load(stores["b"].folder)
    stored.records["ekf"]["diverged"][:] = True
    f = findings.find(stored, "ekf", "ekf", 0.02)
    assert np.isnan(f.accuracy[0].mean.value)
    assert f.accuracy[0].median.value == np.inf
    assert f.anees_needed is None
    assert f.accuracy[0].needed is None


# How it is written


def test_text_fits_a_hundred_columns(both):
    text = formats.render(both, "text")
    assert max(map(len, text.split("\n"))) <= 100
    for title in (
        "Consistency:",
        "Ranking by RMSE:",
        "Pairs on",
        "RMSE:",
        "Coverage:",
        "Runs needed",
    ):
        assert f"\n{title}" in text
    assert "  1=  " in text
    assert not any(line != line.rstrip() for line in text.split("\n"))


def test_too_few_runs_are_said(both, stores):
    assert "can be told apart" not in formats.render(both, "text")
    short = compare_stores([stores["a"].folder])
    short.contests[0].runs.resize(5, refcheck=False)
    assert "With 5 runs no two of 6 estimators can be told apart: take 10" in " ".join(
        formats.render(short, "text").split()
    )


def test_json_is_json_with_every_number(both):
    data = json.loads(formats.render(both, "json"))
    (contest,) = data["contests"]
    assert len(contest["estimators"]) == 7
    assert contest["folders"][1]["runs"] == 24
    ekf = contest["estimators"]["a/ekf"]
    f = both.contests[0].findings[0]
    assert ekf["rmse"]["pole"]["unit"] == "rad"
    assert ekf["rmse"]["pole"]["value"] == f.summary.rmse[1].value
    assert ekf["diverged_share"]["high"] == pytest.approx(0.138, abs=1e-3)
    assert contest["estimators"]["b/ekf"]["nci_db"] is None
    pair = contest["pairs"][-1]
    assert set(pair["rmse_difference"]) == {"cart", "pole", "cart.vel", "pole.vel"}
    assert contest["ranking"][-1]["estimator"] == "b/ekf"


def test_csv_has_one_number_a_row(both):
    rows = list(csv.DictReader(io.StringIO(formats.render(both, "csv"))))
    found = {(r["estimator"], r["against"], r["quantity"], r["coordinate"]): r for r in rows}
    assert len(found) == len(rows)
    f = both.contests[0].findings[0]
    row = found["a/ekf", "", "rmse", "pole"]
    assert (row["unit"], float(row["value"])) == ("rad", f.summary.rmse[1].value)
    assert float(row["low"]) < float(row["value"]) < float(row["high"])
    assert found["a/ekf", "", "verdict", ""]["value"] == str(f.summary.verdict)
    assert found["b/ekf", "", "rank", ""]["value"] == "7"
    assert float(found["a/ekf", "b/ekf", "rmse_ratio", ""]["p_wilcoxon"]) < 0.05
    assert found["a/ekf", "b/ekf", "rmse_difference", "cart"]["unit"] == "m"


def test_markdown_tables_are_rectangular(both):
    text = formats.render(both, "markdown")
    assert text.startswith("## cartpole: 24 runs")
    for block in text.split("\n\n"):
        lines = [line for line in block.split("\n") if line.startswith("|")]
        assert len({line.count(" | ") for line in lines}) <= 1
    assert "| 7 | b/ekf |" in text


def test_latex_is_escaped_and_balanced(both):
    text = formats.render(both, "latex")
    assert text.count(r"\begin{table}") == text.count(r"\end{table}") == 10
    assert "a/sr\\_ekf" in text
    assert r"$\pm$" in text
    body = [line for line in text.split("\n") if not line.startswith("%")]
    assert not any(c in "±σµ×∞" for line in body for c in line)
    for line in body:
        if line.endswith(r"\\"):
            assert "_" not in line.replace(r"\_", "")
            assert "%" not in line.replace(r"\%", "")


# The command line


@pytest.fixture
def call(monkeypatch, capfd):
    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["estbench", *map(str, arguments)])
        with pytest.raises(SystemExit) as exit_:
            cli.main()
        return exit_.value.code or 0, *capfd.readouterr()

    return run


@pytest.mark.parametrize("format_", ["text", "csv"])
def test_the_command_prints_each_format(call, stores, both, format_):
    code, out, err = call("compare", stores["a"].folder, stores["b"].folder, "--format", format_)
    assert (code, err) == (0, "")
    assert out == formats.render(both, format_).rstrip("\n") + "\n"


def test_a_mistake_is_one_line_and_code_2(call, stores, tmp_path):
    a = stores["a"].folder
    for arguments, says in (
        ((a, "--format", "markdow"), "no format 'markdow' (did you mean 'markdown'?)"),
        ((tmp_path,), "holds no data.zarr"),
        ((a, stores["pendulum"].folder), "read stores of one robot together"),
        ((a, "--margin", "2"), "margin is 2; use a number between 0 and 1"),
        ((), "Missing argument"),
    ):
        code, out, err = call("compare", *arguments)
        assert (code, out) == (2, "")
        assert says in err
        assert err.count("\n") == 1


# Little to go by


@pytest.mark.parametrize("format_", FORMATS)
def test_one_run_and_an_estimator_that_lost_every_run(tmp_path, format_):
    folder = tmp_path / "one"
    estbench.run(
        "cartpole", ["ekf", "lkf"], runs=1, duration=5.0, out=folder, batch_size=1,
        keep="diagonal" if format_ == "text" else "summary",
    )  # fmt: skip
    comparison = compare_stores([folder])
    assert [r.lost for r in comparison.contests[0].ranks] == [0.0, 1.0]
    out = formats.render(comparison, format_)
    assert "nan" not in out.lower()
    assert "Infinity" not in out


def test_the_share_of_diverged_runs_has_its_interval_in_the_json_of_a_run(stores):
    found = stores["a"].to_dict()["estimators"]["ekf"]["diverged_interval"]
    assert found == {"value": 0.0, "low": 0.0, "high": pytest.approx(0.138, abs=1e-3)}
