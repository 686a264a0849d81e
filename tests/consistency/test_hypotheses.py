import numpy as np
import pytest
from scipy import stats

from estbench.analysis.calibration import observed
from estbench.analysis.trials import reduced, simulate
from estbench.consistency.hypotheses import (
    CHOSEN,
    VARIABLES,
    WEIGHTS,
    Kind,
    family,
)
from estbench.consistency.intervals import mean_interval, positive_mean_interval
from estbench.consistency.multiplicity import holm
from estbench.inference.lags import LAGS


@pytest.fixture(scope="module")
def record():
    return reduced(simulate(observed(), 30, 50, seed=1))


@pytest.fixture(scope="module")
def found(record):
    return family(record, np.ones(30, bool), 0.95)


def test_every_kind_has_a_weight_and_its_variables():
    assert set(WEIGHTS) == set(VARIABLES) == set(Kind)
    some = WEIGHTS[Kind.NEES_PHASE] + WEIGHTS[Kind.INNOVATION]  # of robots with contact, of logs
    assert sum(WEIGHTS.values()) - some == pytest.approx(1.0)


def test_how_many_hypotheses_there_are(found):
    count = {kind: sum(h.kind is kind for h in found) for kind in Kind}
    assert count == {
        Kind.NEES: 1, Kind.NEES_BLOCK: 10, Kind.NEES_SIZE: 2, Kind.NEES_RUNS: 0, Kind.COORDINATE: 2,
        Kind.COORDINATE_BLOCK: 20, Kind.BIAS: 2, Kind.BIAS_BLOCK: 20, Kind.NIS: 1, Kind.CHANNEL: 2,
        Kind.WHITENESS: LAGS, Kind.NIS_BLOCK: 10, Kind.NEES_PHASE: 0, Kind.NEES_ALONG: 2,
        Kind.COORDINATE_SIZE: 4, Kind.INNOVATION: 0,
    }  # fmt: skip
    places = {(h.coordinate, h.block) for h in found if h.kind is Kind.BIAS_BLOCK}
    assert places == {(c, b) for c in range(2) for b in range(10)}


def test_means_and_intervals_are_those_of_the_statistics(found, record):
    for h in found:
        if h.kind in (Kind.NEES, Kind.NEES_BLOCK, Kind.COORDINATE_BLOCK, Kind.CHANNEL):
            values = record[VARIABLES[h.kind][0]]
            index = [i for i in (h.block, h.coordinate, h.channel) if i is not None]
            expected = positive_mean_interval(values[(slice(None), *index)])
        elif h.kind is Kind.BIAS_BLOCK:
            expected = mean_interval(record["scaled_error"][:, h.block, h.coordinate])
        elif h.kind is Kind.COORDINATE:
            expected = positive_mean_interval(record["scaled_square"].mean(axis=1)[:, h.coordinate])
        else:
            continue
        got = (h.mean.value, h.mean.low, h.mean.high)
        assert got == pytest.approx((expected.value, expected.low, expected.high), rel=1e-10)


def test_a_p_value_is_5_percent_where_the_interval_ends(found):
    """The p-value of the ideal value and the interval are one test."""
    for h in found:
        assert (h.p < 0.05) == (h.ideal not in h.mean)
    bias = next(h for h in found if h.kind is Kind.BIAS)
    t = bias.mean.value / (bias.spread / np.sqrt(30))
    assert bias.p == pytest.approx(2 * stats.t.sf(abs(t), 29), rel=1e-10)


def test_holm_is_over_the_whole_family(found):
    number = {kind: sum(h.kind is kind for h in found) for kind in Kind}
    weights = [WEIGHTS[h.kind] / number[h.kind] for h in found]
    expected = holm([h.p for h in found], weights)
    np.testing.assert_allclose([h.adjusted for h in found], expected)


def test_runs_are_told_apart_by_their_covariance(record):
    spread = np.exp(np.random.default_rng(0).normal(0, 0.5, (30, 1)))
    changed = {**record, "variance": record["variance"] * spread}
    small, large = (h for h in family(changed, np.ones(30, bool), 0.95) if h.kind is Kind.NEES_RUNS)
    below = spread[:, 0] < np.median(spread)
    assert (small.runs, large.runs) == (15, 15)
    assert small.mean.value == pytest.approx(record["anees"][below].mean())
    assert large.mean.value == pytest.approx(record["anees"][~below].mean())


def phased(record, nees, steps=(5, 10, 35)):
    """The record with NEES/n by phase, of mean 1 times the factors."""
    rng = np.random.default_rng(4)
    values = rng.gamma(40, 1 / 40, (30, 3)) * np.asarray(nees)
    return {**record, "anees_by_phase": values, "phase_steps": np.tile(steps, (30, 1))}


def test_a_phase_of_contact_is_refuted_beyond_what_choosing_it_by_the_truth_explains(record):
    """p is that of the mean at the nearer end of [1/CHOSEN, CHOSEN]; 1 within."""
    every = np.ones(30, bool)
    for nees, wrong in (
        ((1, 1, 1), ()),
        ((1.3, 0.75, 1.45), ()),
        ((1, 1, 4), (2,)),
        ((0.3, 1, 1), (0,)),
    ):
        found = [h for h in family(phased(record, nees), every, 0.95) if h.kind is Kind.NEES_PHASE]
        assert [h.place for h in found] == [0, 1, 2]
        assert tuple(h.place for h in found if h.p < 0.01) == wrong
        for h in found:
            expected = positive_mean_interval(phased(record, nees)["anees_by_phase"][:, h.place])
            assert h.mean.value == pytest.approx(expected.value)
            if 1 / CHOSEN <= h.mean.value <= CHOSEN:
                assert h.p == 1.0


def test_where_all_instants_are_of_one_phase_there_is_none(record):
    alone = phased(record, (1, 1, 4), (0, 0, 50))
    assert not [h for h in family(alone, np.ones(30, bool), 0.95) if h.kind is Kind.NEES_PHASE]


def test_a_column_without_values_is_no_hypothesis(record):
    bare = {**record, "channel_nis": record["channel_nis"] * np.array([1.0, np.nan])}
    bare["nees_by_block"] = np.where(np.arange(10) < 4, bare["nees_by_block"], np.nan)
    found = family(bare, np.ones(30, bool), 0.95)
    assert [h.channel for h in found if h.kind is Kind.CHANNEL] == [0]
    assert [h.block for h in found if h.kind is Kind.NEES_BLOCK] == [0, 1, 2, 3]


def test_errors_that_are_all_zero_are_far_too_small(record):
    zero = {**record, "anees": np.zeros(30)}
    nees = next(h for h in family(zero, np.ones(30, bool), 0.95) if h.kind is Kind.NEES)
    assert (nees.p, nees.mean.low, nees.mean.high) == (0.0, 0.0, 0.0)
