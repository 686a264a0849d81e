"""The record of a run that comes in windows is that of the run as a whole."""

from dataclasses import replace

import numpy as np
import pytest

from estbench.consistency.records import reduce
from estbench.consistency.windows import AT_INSTANTS, AT_TIMES, Windows
from estbench.estimators.beliefs import Fault
from estbench.inference.traces import Traces
from estbench.scenario.schema import ConsistencySection

COUNT, RUNS, N = 60, 4, 2
TIMES = np.linspace(0.0, 6.0, COUNT + 1)
SECTION = ConsistencySection(burn_in=0.5, divergence_duration=1.0, divergence_threshold=50.0)
NOBODY = np.full(RUNS, -1), np.zeros(RUNS, bool)


def traces() -> Traces:
    rng = np.random.default_rng(0)
    shape = COUNT + 1, RUNS
    nees = rng.chisquare(N, shape)
    nees[25:35, 1] = 1e4  # ten in a row, over the end of a window
    nees[40:49, 2] = 1e4  # nine
    error = rng.standard_normal((*shape, N))
    error[50:, 3] = nees[50:, 3] = np.nan
    dof = rng.integers(0, 3, (COUNT, RUNS))
    nis = np.where(dof > 0, rng.chisquare(2, (COUNT, RUNS)), np.nan)
    std = rng.uniform(0.5, 2.0, (*shape, N))
    std[:, 0, 1] = 0.0  # known exactly
    return Traces(
        truth=error, mean=error, error=error, std=std, nees=nees,
        rank=np.where(rng.random(shape) < 0.1, 0, N), along=rng.standard_normal((*shape, 3)) ** 2,
        nis=nis, dof=dof, log_likelihood=rng.standard_normal((COUNT, RUNS)), gated=dof // 2,
        channel_nis=nis[..., None], lags=np.ones((RUNS, 11)), lag_terms=np.ones((RUNS, 11), int),
        fault=np.array([0, 0, 0, Fault.STATE], np.uint8), fault_step=np.array([-1, -1, -1, 50]),
        late=np.arange(RUNS), cpu_time=1.0, bound=rng.random((*shape, N)),
    )  # fmt: skip


def phases():
    touching = np.arange(COUNT + 1)[:, None] % (3 + np.arange(RUNS)) < 2
    event = np.zeros((COUNT + 1, RUNS), bool)
    event[31:33, 1:] = True
    return np.stack([~touching & ~event, touching & ~event, event], axis=-1)


def window(whole: Traces, first: int, stop: int) -> Traces:
    """The times from `first` up to `stop`."""
    values = {name: getattr(whole, name) for name in AT_TIMES + AT_INSTANTS}
    parts = {name: v[first : stop - (name in AT_INSTANTS)] for name, v in values.items()
             if v is not None}  # fmt: skip
    return replace(whole, **parts)


def in_windows(whole: Traces, ends: list[int], sample, seen=None, of=NOBODY):
    found, first = Windows(TIMES, SECTION, sample), 0
    for end in ends:
        assert not found.finished
        part = None if seen is None else seen[first : end + 1]
        found.add(window(whole, first, end + 1), part)
        first = end
    assert found.finished
    return found.record(*of)


@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize("seen", [None, phases()])
@pytest.mark.parametrize("ends", [[30, COUNT], [1, 28, 32, 33, COUNT]])
def test_windows_give_the_record_of_the_whole(ends, seen):
    whole = traces()
    expected = reduce(whole, TIMES, SECTION, "summary", seen)
    found = in_windows(whole, ends, np.arange(COUNT + 1), seen)
    assert found.keys() == expected.keys()
    assert expected["diverged"].tolist() == [False, True, False, True]
    for name, value in expected.items():
        assert found[name].dtype == value.dtype, name
        np.testing.assert_allclose(found[name], value, rtol=1e-12, err_msg=name)


@pytest.mark.filterwarnings("ignore:invalid value")
def test_sums_at_the_instants_and_medians_are_those_of_the_sample():
    whole, sample = traces(), np.array([0, 7, 14, 21, 28, 35, 42, 49, 56, COUNT])
    expected = reduce(whole, TIMES, SECTION, "summary")
    found = in_windows(whole, [30, COUNT], sample)
    for name in ("count", "nees_sum", "nis_sum", "dof_sum", "square_sum", "bound_sum"):
        np.testing.assert_allclose(found[name], expected[name][:, sample], err_msg=name)
    np.testing.assert_allclose(found["anees"], expected["anees"])
    assert found["fault_step"].tolist() == [-1, -1, -1, 8]  # at 50: the next of the sample is 56
    assert np.isfinite(found["nees_by_size"][0]).all()


@pytest.mark.filterwarnings("ignore:invalid value")
def test_a_run_without_truth_says_why():
    whole = traces()
    ended, lost = np.array([10, -1, 20, -1]), np.array([False, False, True, False])
    whole = replace(whole, fault=np.array([0, 0, Fault.TRUTH, Fault.STATE], np.uint8),
                    fault_step=np.array([-1, -1, 20, 50]))  # fmt: skip
    found = in_windows(whole, [COUNT], np.arange(COUNT + 1), of=(ended, lost))
    assert found["fault"].tolist() == [Fault.TRUTH, 0, Fault.REFERENCE, Fault.STATE]
    assert found["fault_step"].tolist() == [10, -1, 20, 50]
