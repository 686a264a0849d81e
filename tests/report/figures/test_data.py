from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from estbench.consistency.coverage import SIGMAS
from estbench.consistency.intervals import Interval, mean_interval, positive_mean_interval
from estbench.consistency.nees import chi_square_band
from estbench.consistency.verdict import Verdict
from estbench.report import facts
from estbench.report.figures import data, traces


@pytest.fixture
def pair(entries):
    return entries("two")


def test_nees_is_the_mean_of_the_traces_in_the_band_of_consistency(pair):
    entry = pair[0]
    steps = data.nees_steps(entry)
    nees = entry.group["nees"].values[entry.good]
    np.testing.assert_allclose(steps.mean, nees.mean(axis=0) / entry.source.n, rtol=1e-12)
    low, high = chi_square_band(entry.source.n, len(nees), 0.95)
    np.testing.assert_allclose(steps.low * entry.source.n, low, rtol=1e-12)
    np.testing.assert_allclose(steps.high * entry.source.n, high, rtol=1e-12)
    out = (steps.mean < steps.low) | (steps.mean > steps.high)
    assert steps.outside == out[entry.source.settled].mean()
    assert not steps.counts[0]  # the prior is drawn but does not count


@pytest.mark.parametrize(
    ("verdict", "value", "words"),
    [(Verdict.OVERCONFIDENT, 4.0, "larger"), (Verdict.CONSERVATIVE, 0.25, "smaller")],
)
def test_the_sentence_says_of_what_the_root_of_nees_is(pair, verdict, value, words):
    anees = Interval(value, value - 0.1, value + 0.1)
    judgement = replace(pair[0].summary.judgement, verdict=verdict)
    entry = replace(pair[0], summary=replace(pair[0].summary, judgement=judgement, anees=anees))
    said = facts.verdict(entry, data.nees_steps(entry))
    root = f"{value**0.5:g} σ in root mean square along the covariance's own axes"
    assert f"its errors are {words} than its covariance says, {root}." in said


def test_nis_skips_instants_without_a_reading(pair):
    entry = pair[0]
    nis, dof = entry.group["nis"].values, entry.group["dof"].values
    steps = data.nis_steps(entry)
    used = dof.any(axis=0)
    np.testing.assert_allclose(steps.time, entry.source.times[used])
    expected = np.nansum(nis, axis=0)[used] / dof.sum(axis=0)[used]
    np.testing.assert_allclose(steps.mean, expected, rtol=1e-12)
    low, _ = chi_square_band(float(dof[0, -1]), len(nis), 0.95)
    assert steps.low[-1] == pytest.approx(low / dof[0, -1])


def test_rmse_interval_is_that_of_the_mean_squared_error(pair):
    entry = pair[0]
    statistics = traces.statistics(entry)
    assert statistics is not None
    curve = data.rmse_steps(entry, statistics.fourth)
    error = entry.group["error"].values
    for step in (1, 37, -1):
        for i in range(entry.source.n):
            interval = positive_mean_interval(error[:, step, i] ** 2, 0.95)
            assert curve.rmse[step, i] ** 2 == pytest.approx(interval.value, rel=1e-12)
            assert curve.high[step, i] ** 2 == pytest.approx(interval.high, rel=1e-9)
            assert curve.low[step, i] ** 2 == pytest.approx(interval.low, rel=1e-9)
    bare = data.rmse_steps(entry)
    assert not bare.exact
    bound = (error[:, -1] ** 2).sum(axis=0) / stats.chi2.ppf(0.025, len(error))
    np.testing.assert_allclose(bare.high[-1] ** 2, bound, rtol=1e-12)


def test_thinning_keeps_the_extremes():
    values = np.random.default_rng(0).standard_normal(10_000)
    values[5678], values[1234] = 50, -50
    keep = data.thin(values, 100)
    assert len(keep) <= 102
    assert {0, 1234, 5678, 9999} <= set(keep)
    assert (np.diff(keep) > 0).all()
    np.testing.assert_array_equal(data.thin(values[:50], 100), np.arange(50))
    table = np.stack([values, -values, np.full(10_000, np.nan)], axis=1)
    assert {1234, 5678} <= set(data.thin(table, 100))


def test_chosen_runs_are_the_worst_and_the_best(pair):
    chosen = data.choose_runs(pair, 6)
    anees = pair[0].record["anees"]
    why = {c.run: c.why for c in chosen}
    assert "worst" in why[int(anees.argmax())]
    assert "best" in why[int(anees.argmin())]
    assert len(chosen) <= 6


def test_trace_statistics_are_those_of_all_runs(pair):
    entry = pair[0]
    found = traces.statistics(entry)
    assert found is not None
    group, settled = entry.group, entry.source.settled
    ratio = (group["error"].values / group["std"].values)[:, settled]
    width = np.diff(traces.ERROR_EDGES)
    counts = np.histogram(ratio[..., 0], traces.ERROR_EDGES)[0]
    np.testing.assert_allclose(found.errors[0] * width * ratio[..., 0].size, counts)
    assert found.beyond[0] == pytest.approx((np.abs(ratio[..., 0]) > 5).mean())
    nees = group["nees"].values[:, settled]
    low, high = chi_square_band(entry.source.n, 1, 0.95)
    assert found.outside[0] == pytest.approx(((nees < low) | (nees > high)).mean())


def test_coverage_is_that_of_the_traces_and_stays_a_share(pair):
    entry = pair[0]
    found, group = data.coverage(entry), entry.group
    assert found is not None
    ratio = (group["error"].values / group["std"].values)[:, entry.source.settled]
    beyond = False
    for k, sigmas in enumerate(SIGMAS):
        for i in range(entry.source.n):
            expected = mean_interval((np.abs(ratio[..., i]) <= sigmas).mean(axis=1), 0.95)
            shown = found[i].shares[k]
            assert shown.value == pytest.approx(expected.value)
            assert shown.low == pytest.approx(expected.low)
            assert shown.high == pytest.approx(min(expected.high, 1.0))
            beyond |= expected.high > 1
    assert beyond


def test_autocorrelation_of_independent_nis_is_in_its_band(pair, monkeypatch):
    entry = pair[0]
    rng = np.random.default_rng(1)
    shape = entry.group["nis"].shape
    dof = rng.integers(0, 4, shape)
    nis = np.where(dof > 0, stats.chi2.rvs(np.maximum(dof, 1), random_state=rng), np.nan)
    products, pairs = traces._products(nis, dof)
    correlation = products / pairs
    assert correlation[0] == pytest.approx(1, abs=0.15)
    inside = np.abs(correlation[1:]) < 1.96 / np.sqrt(pairs[1:])
    assert inside.mean() > 0.85
    used = (dof > 0) & np.isfinite(nis)
    z = np.where(used, (nis - dof) / np.sqrt(2 * np.maximum(dof, 1)), 0)
    assert products[3] == pytest.approx((z[:, :-3] * z[:, 3:]).sum())
    assert pairs[3] == (used[:, :-3] & used[:, 3:]).sum()


def test_run_trace_is_the_stored_one(pair):
    entry = pair[1]
    trace = traces.run_trace(entry, 7, 500)
    assert trace is not None
    np.testing.assert_array_equal(trace.error, entry.group["error"].values[7].T)
    np.testing.assert_array_equal(trace.nees, entry.group["nees"].values[7] / entry.source.n)
    few = traces.run_trace(entry, 7, 20)
    assert few is not None
    ratio = np.abs(entry.group["error"].values[7] / entry.group["std"].values[7]).max(axis=1)
    assert entry.source.times[ratio.argmax()] in few.time
    assert traces.run_trace(entry, 99, 20) is None


def test_a_store_without_traces_has_no_trace_statistics(entries):
    assert traces.statistics(entries("bare")[0]) is None
