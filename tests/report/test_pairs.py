"""Differences are those of `estbench compare`; p-values are Holm's."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from estbench.analysis.compare import compare_stores
from estbench.consistency.intervals import Interval, mean_interval
from estbench.consistency.multiplicity import holm
from estbench.report import pairs, tables


@pytest.fixture
def pair(entries):
    return entries("two")


def worse(entry, key, factor):
    """A third entry whose every error is so many times as large."""
    record = {**entry.record, "mse": entry.record["mse"] * factor**2}
    return replace(entry, key=key, record=record)


def test_they_are_those_of_the_comparison(store, pair):
    (contest,) = compare_stores([store("two")]).contests
    ((rmse, nees),) = contest.details()
    one, other = pairs.differences(pair)
    assert (one.entry, one.baseline) == (other.baseline, other.entry) == ("ekf", "ukf")
    assert one.score == contest.pairs[0]
    assert one.rmse == rmse
    assert one.nees == nees
    np.testing.assert_array_equal(one.p, holm([q.wilcoxon for q in (nees, *rmse)]))


def test_the_other_way_round(pair):
    one, other = pairs.differences(pair)
    there = pairs.differences(pair[::-1])[0]
    for a, b in ((other.nees, there.nees), *zip(other.rmse, there.rmse)):
        assert a == b
    assert other.score.ratio.value == pytest.approx(there.score.ratio.value, rel=1e-12)
    assert other.score.ratio.low == pytest.approx(1 / one.score.ratio.high, rel=1e-12)
    assert other.cost == pytest.approx(1 / one.cost)
    difference = np.sqrt(pair[1].record["mse"]) - np.sqrt(pair[0].record["mse"])
    assert other.rmse[1].difference == mean_interval(difference[:, 1], 0.95)


def test_holm_is_over_all_quantities_of_all_pairs(pair):
    entries = [*pair, worse(pair[0], "bad", 3.0)]
    found = pairs.differences(entries)
    assert len(found) == 6
    raw = [q.wilcoxon for d in found[::2] for q in (d.nees, *d.rmse)]
    np.testing.assert_array_equal(np.concatenate([d.p for d in found[::2]]), holm(raw))
    bad = next(d for d in found if (d.entry, d.baseline) == ("bad", "ekf"))
    error = np.sqrt(pair[0].record["mse"])
    exact = stats.wilcoxon((3 - 1) * error[:, 0]).pvalue
    assert exact == 2.0**-11  # of 12 runs, all of one sign
    assert exact < bad.p[1] <= 9 * exact
    assert bad.score.differ
    assert bad.score.ratio.value == pytest.approx(3)


def test_a_cell_is_coloured_where_the_corrected_test_tells_the_two_apart(pair):
    entries = [*pair, worse(pair[0], "bad", 3.0)]
    (table,) = (b for b in tables.baselines(entries) if b["key"] == "ekf")
    rows = {name: cells for name, _, cells in table["rows"]}
    assert [c["class"] for c in rows["hinge"]] == ["", "more"]  # ukf, bad
    assert [c["class"] for c in rows["RMSE, all coordinates"]] == ["", "more"]
    assert rows["hinge"][1]["shown"].endswith("▲")
    (table,) = (b for b in tables.baselines(entries) if b["key"] == "bad")
    rows = {name: cells for name, _, cells in table["rows"]}
    assert [c["class"] for c in rows["hinge"]] == ["less", "less"]


def test_a_difference_that_only_an_uncorrected_interval_finds_is_not_coloured():
    """One of 60 tests is bound to look significant."""
    i = Interval(1.0, 0.1, 1.9)
    shown = pairs.Paired(12, i, 0.0, 3, 9, 0, 0.6, 0.15, 0.03)
    assert tables._difference(shown, 1.0, 0.03, 0.95)["class"] == "more"
    assert tables._difference(shown, 1.0, 60 * 0.03, 0.95)["class"] == ""
    assert tables._difference(shown, 1000.0, 0.03, 0.95)["class"] == ""  # too small to matter


def test_entries_without_a_common_run_have_no_differences(pair):
    elsewhere = replace(pair[1].source, runs=pair[1].source.runs + 100)
    assert pairs.differences([pair[0], replace(pair[1], source=elsewhere)]) == []
    assert pairs.differences(pair[:1]) == []


def test_a_lost_run_counts_as_worse(entries):
    (entry,) = entries("lost")
    whole = replace(entry, key="whole")
    kept = {**entry.record, "diverged": np.zeros_like(entry.record["diverged"])}
    one = pairs.differences([replace(entry, key="lost"), replace(whole, record=kept)])[0]
    lost = int((~entry.good).sum())
    assert one.score.paired.more == lost > 0
    assert one.nees.runs == len(entry.good) - lost
