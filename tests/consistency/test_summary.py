from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from estbench.analysis.findings import accuracies
from estbench.consistency import records
from estbench.consistency import summary as statistics
from estbench.consistency.verdict import Verdict
from estbench.estimators.beliefs import Fault
from estbench.inference.traces import Traces
from estbench.scenario.schema import ConsistencySection
from estbench.spaces.directions import directions

TIMES = np.array([0.0, 0.1, 0.2, 0.3, 0.4])
SECTION = ConsistencySection(burn_in=0.1, divergence_threshold=10.0, divergence_duration=0.2)


def traces(runs=6, steps=4, n=2, seed=0, spread=1.0, most=2.0):
    rng = np.random.default_rng(seed)
    error = spread * rng.standard_normal((steps + 1, runs, n))
    dof = np.tile([1, 0, 2, 2][:steps], (runs, 1)).T
    nis = np.where(dof > 0, rng.chisquare(np.maximum(dof, 1)), np.nan)
    each = nis / np.maximum(dof, 1)
    mean = rng.standard_normal(error.shape)
    return Traces(
        truth=mean + error, mean=mean, error=error,
        std=np.ones_like(error) * rng.uniform(1, most, n),
        nees=(error**2).sum(axis=-1), rank=np.full((steps + 1, runs), n),
        along=(error @ directions(n)) ** 2,
        nis=nis, dof=dof,
        log_likelihood=np.where(dof > 0, rng.standard_normal(dof.shape), 0.0),
        gated=np.minimum(dof, 1), channel_nis=np.stack([each, np.where(dof > 1, each, np.nan)], -1),
        lags=rng.normal([9.0, 0.0, 0.0], 1.0, (runs, 3)), lag_terms=np.tile([9, 8, 7], (runs, 1)),
        fault=np.zeros(runs, np.uint8), fault_step=np.full(runs, -1), late=np.arange(runs),
        cpu_time=6e-3,
        cov=np.tile(np.eye(n), (steps + 1, runs, 1, 1)),
        innovation=rng.standard_normal((steps + 1, runs, 3)),
        innovation_cov=rng.standard_normal((steps + 1, runs, 3, 3)),
    )  # fmt: skip


def fail(whole, run, step):
    """Run `run` is NaN from `step` on."""
    out = {f: getattr(whole, f).copy() for f in ("mean", "error", "std", "nees", "nis")}
    for name, value in out.items():
        value[step - (name == "nis") :, run] = np.nan
    out["fault"], out["fault_step"] = whole.fault.copy(), whole.fault_step.copy()
    out["fault"][run], out["fault_step"][run] = Fault.COVARIANCE, step
    return replace(whole, **out)


def part(whole, runs):
    values = {
        name: value[runs] if value.ndim == 1 or "lag" in name else value[:, runs]
        for name, value in vars(whole).items()
        if isinstance(value, np.ndarray)
    }
    return replace(whole, **values, cpu_time=whole.cpu_time * len(runs) / whole.nees.shape[1])


def reduce(whole, keep="summary"):
    return records.reduce(whole, TIMES, SECTION, keep)


# What is recorded of a batch


def test_averages_of_a_run_by_hand():
    t = traces()
    record = reduce(t)
    settled = [2, 3, 4]  # after 0.1 s
    for run in range(6):
        assert record["anees"][run] == pytest.approx(t.nees[settled, run].mean() / 2)
        # of the updates after 0.1 s one has no reading, the others two numbers each
        assert record["anis"][run] == pytest.approx((t.nis[2, run] + t.nis[3, run]) / 2 / 2)
        np.testing.assert_allclose(record["mse"][run], (t.error[settled, run] ** 2).mean(axis=0))
        np.testing.assert_allclose(record["variance"][run], (t.std[settled, run] ** 2).mean(axis=0))
    np.testing.assert_allclose(record["lag_one"], (t.lags[:, 1] / 8) / (t.lags[:, 0] / 9))
    for k in (1, 2, 3):
        share = (np.abs(t.error[settled]) <= k * t.std[settled]).mean(axis=0)
        np.testing.assert_allclose(record[f"inside_{k}"], share)
    np.testing.assert_allclose(record["cpu_time"], 1e-3)


def test_the_prior_is_never_averaged():
    t = traces()
    without = records.reduce(t, TIMES, ConsistencySection(), "summary")
    np.testing.assert_allclose(without["anees"], t.nees[1:].mean(axis=0) / 2)
    np.testing.assert_allclose(without["anis"], (t.nis[[0, 2, 3]] / [[1], [2], [2]]).mean(axis=0))


def test_sums_over_the_runs_that_did_not_diverge():
    t = fail(traces(), run=1, step=3)
    t.nees[1:3, 4] = 99.0  # lost, though it did not fail
    record = reduce(t)
    good = [0, 2, 3, 5]
    np.testing.assert_array_equal(record["count"], [[4] * 5])
    np.testing.assert_allclose(record["nees_sum"], [t.nees[:, good].sum(axis=1)])
    np.testing.assert_allclose(record["nis_sum"][0, 1:], np.nansum(t.nis[:, good], axis=1))
    np.testing.assert_array_equal(record["dof_sum"], [[0, 4, 0, 8, 8]])
    np.testing.assert_allclose(record["square_sum"], [(t.error[:, good] ** 2).sum(axis=1)])
    np.testing.assert_allclose(record["variance_sum"], [(t.std[:, good] ** 2).sum(axis=1)])


def test_failed_and_lost_runs_are_diverged():
    t = fail(traces(), run=1, step=3)
    t.nees[1:3, 4] = 99.0  # two steps in a row above 10 n
    t.nees[[1, 3], 5] = 99.0  # not in a row
    record = reduce(t)
    np.testing.assert_array_equal(record["diverged"], [False, True, False, False, True, False])
    assert np.isnan([record["anees"][1], record["anis"][1], *record["mse"][1]]).all()
    assert (record["fault"][1], record["fault_step"][1]) == (Fault.COVARIANCE, 3)


def test_a_run_without_readings_has_no_nis():
    t = traces()
    record = reduce(replace(t, nis=np.full_like(t.nis, np.nan), dof=np.zeros_like(t.dof)))
    assert np.isnan(record["anis"]).all()
    np.testing.assert_array_equal(record["nis_sum"], np.zeros((1, 5)))


@pytest.mark.parametrize("keep", ["summary", "diagonal", "full"])
def test_a_record_has_the_declared_fields_dimensions_and_types(keep):
    record = reduce(traces(), keep)
    assert set(record) == set(records.fields(keep) | records.COST)
    sizes = {"run": 6, "time": 5, "batch": 1, "coordinate": 2, "coordinate_": 2, "state": 2,
             "reading": 3, "reading_": 3, "lag": 3, "block": 10, "size": 2,
             "direction": 4, "phase": 3, "side": 2, "channel": 2}  # fmt: skip
    for name in record.keys() & records.fields(keep).keys():
        field = records.fields(keep)[name]
        assert record[name].shape == tuple(sizes[d] for d in field.dims), name
        assert np.can_cast(record[name].dtype, np.dtype(field.dtype), "same_kind"), name


def test_traces_are_run_major_and_nis_stands_at_its_instant():
    t = traces()
    record = reduce(t, "full")
    np.testing.assert_array_equal(record["error"][3, 4], t.error[4, 3])
    np.testing.assert_array_equal(record["estimate"][3, 4], t.mean[4, 3])
    np.testing.assert_array_equal(record["innovation"][3, 4], t.innovation[4, 3])
    np.testing.assert_array_equal(record["innovation_cov"][3, 4], t.innovation_cov[4, 3])
    np.testing.assert_array_equal(record["nis"][3, 1:], t.nis[:, 3])
    assert np.isnan(record["nis"][:, 0]).all()
    np.testing.assert_array_equal(record["dof"][3], [0, 1, 0, 2, 2])
    np.testing.assert_array_equal(record["cov"][3, 4], np.eye(2))


# Batches


def test_merged_batches_are_one_batch():
    whole = fail(traces(), run=1, step=3)
    one = reduce(whole)
    runs = [[0, 1, 2, 3], [4, 5]]
    merged = records.merge([reduce(part(whole, r)) for r in runs])
    assert set(merged) == set(records.SUMMARY | records.COST)
    for name, field in records.SUMMARY.items():
        if field.dims[0] == "run":
            np.testing.assert_allclose(merged[name], one[name], rtol=1e-12, err_msg=name)
        else:
            assert len(merged[name]) == 2
            np.testing.assert_allclose(merged[name].sum(axis=0), one[name][0], err_msg=name)
    a, b = (
        statistics.summarize("x", record, range(6), TIMES, SECTION, "ab")
        for record in (one, merged)
    )
    assert str(replace(a, cost=0.0)) == str(replace(b, cost=0.0))
    assert a.cost == pytest.approx(b.cost)


# The summary


def summarize(record, section=SECTION):
    runs = range(10, 10 + len(record["anees"]))
    return statistics.summarize("ekf", record, runs, TIMES, section, ("a", "b"), ("c", "d"))


def test_summary_by_hand():
    record = reduce(fail(traces(runs=7), run=1, step=3))
    good = np.array([0, 2, 3, 4, 5, 6])
    summary = summarize(record)
    assert (summary.label, summary.runs) == ("ekf", 7)
    assert summary.diverged == pytest.approx(1 / 7)

    def wilson_hilferty(values):
        c2 = values.var(ddof=1) / values.mean() ** 2
        half = stats.t.ppf(0.975, 5 / (1 + c2)) * np.sqrt(c2 / 54)
        return [values.mean() / (1 - c2 / 54 + side * half) ** 3 for side in (1, -1)]

    for interval, name in ((summary.anees, "anees"), (summary.anis, "anis")):
        values = record[name][good]
        assert interval.value == pytest.approx(values.mean())
        assert [interval.low, interval.high] == pytest.approx(wilson_hilferty(values))
    values = record["lag_one"][good]
    half = stats.t.ppf(0.975, 5) * values.std(ddof=1) / np.sqrt(6)
    expected = [values.mean() + side * half for side in (0, -1, 1)]
    got = [summary.lag_one.value, summary.lag_one.low, summary.lag_one.high]
    assert got == pytest.approx(expected)
    share = summary.diverged_interval
    assert (share.low, share.high) == pytest.approx((0.02568, 0.51313), abs=1e-5)
    for i in range(2):
        mse = record["mse"][good, i]
        got = summary.rmse[i]
        assert got.value == pytest.approx(np.sqrt(mse.mean()))
        assert [got.low, got.high] == pytest.approx(np.sqrt(wilson_hilferty(mse)))
        assert summary.std[i] == pytest.approx(np.sqrt(record["variance"][good, i].mean()))
        # The median counts the failed run as infinitely bad: the 4th of 6 finite and one infinite.
        assert summary.rmse_median[i] == pytest.approx(np.sqrt(np.sort(mse)[3]))
    assert summary.anees_median == pytest.approx(np.sort(record["anees"][good])[3])
    assert summary.cost == pytest.approx(1e6 * 6e-3 / 7 / 4)
    assert summary.failures == (
        statistics.Failure(11, 0.3, "the state covariance P is not positive semidefinite"),
    )


def test_intervals_are_of_plain_numbers():
    summary = summarize(reduce(traces(runs=7)))
    intervals = (summary.anees, summary.anis, summary.lag_one, summary.diverged_interval)
    for interval in (*intervals, *summary.rmse):
        assert [type(x) for x in vars(interval).values()] == [float] * 3


@pytest.mark.parametrize(
    ("spread", "verdict"),
    [(1.0, Verdict.CONSISTENT), (1.5, Verdict.OVERCONFIDENT), (0.6, Verdict.CONSERVATIVE)],
)
def test_verdict_of_many_runs(spread, verdict):
    record = reduce(traces(runs=2000, spread=spread, seed=4, most=1.0))
    record["diverged"][:] = False
    assert summarize(record).verdict is verdict


def test_level_and_tolerance_come_from_the_section():
    record = reduce(traces(runs=200, most=1.0))
    narrow, wide = (summarize(record, ConsistencySection(level=level)) for level in (0.5, 0.99))
    assert wide.anees.high - wide.anees.low > 2 * (narrow.anees.high - narrow.anees.low)
    record["anees"] *= 1.2
    assert summarize(record, ConsistencySection(tolerance=0.0)).verdict is Verdict.OVERCONFIDENT
    assert summarize(record, ConsistencySection(tolerance=0.5)).verdict is Verdict.CONSISTENT


def test_more_than_one_run_in_twenty_diverged():
    record = reduce(traces(runs=100))
    record["diverged"][:] = np.arange(100) < 5
    assert summarize(record).verdict is not Verdict.DIVERGING
    record["diverged"][5] = True
    assert summarize(record).verdict is Verdict.DIVERGING


def test_nothing_but_failures():
    whole = traces(runs=2)
    summary = summarize(reduce(fail(fail(whole, 0, 1), 1, 2)))
    assert summary.verdict is Verdict.DIVERGING
    assert summary.diverged == 1.0
    assert np.isnan([summary.anees.value, *summary.std, summary.rmse[0].value]).all()
    assert summary.anees_median == np.inf
    assert [f.time for f in summary.failures] == [0.1, 0.2]


def test_one_run_decides_nothing():
    assert summarize(reduce(traces(runs=1))).verdict is Verdict.UNDECIDED


def test_a_diverged_run_counts_in_no_mean_though_it_did_not_fail():
    whole = traces(runs=7)
    whole.error[:, 4] *= 1e3
    whole.std[:, 4] *= 1e3
    whole.nees[:, 4] = 99.0  # above 10 n, and finite: the run diverges without a failure
    whole.nis[:, 4] *= 1e3
    whole.lags[4, 1] *= 1e3
    record = reduce(whole)
    np.testing.assert_array_equal(np.flatnonzero(record["diverged"]), [4])
    assert np.isfinite(record["mse"]).all()
    found, others = summarize(record), summarize(reduce(part(whole, [0, 1, 2, 3, 5, 6])))
    assert others.diverged == 0
    assert found.rmse == others.rmse
    assert (found.anees, found.anis, found.lag_one) == (others.anees, others.anis, others.lag_one)
    np.testing.assert_array_equal(found.std, others.std)
    # Medians and the share are over all runs.
    assert found.rmse_median[0] > others.rmse_median[0]
    assert found.anees_median > others.anees_median
    assert found.diverged == pytest.approx(1 / 7)
    by_unit, without = (
        accuracies(reduce(t), ("a", "b"), ("m", "m"), 0.95, 0.02)[0]
        for t in (whole, part(whole, [0, 1, 2, 3, 5, 6]))
    )
    assert (by_unit.mean, by_unit.sigma) == (without.mean, without.sigma)
    assert (by_unit.needed, by_unit.coverage) == (without.needed, without.coverage)
    assert by_unit.median.value > without.median.value
