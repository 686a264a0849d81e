"""Long runs are computed window after window, with the results of the runs as a whole."""

import tracemalloc

import numpy as np
import pytest

from estbench.analysis.load import load
from estbench.errors import StoreError
from estbench.estimators.beliefs import Fault
from estbench.experiment import long
from estbench.experiment.setup import build
from estbench.montecarlo import batch
from estbench.montecarlo.run import run
from estbench.scenario.load import resolve
from estbench.store.zarr import Store

ALL = {"SAMPLE": 10**6, "LEAST": 1}


def prepared(robot, estimators=("ekf",), instants=300, runs=3, overrides=()):
    period = build(resolve(robot, estimators, runs)).plant.period
    return build(resolve(robot, estimators, runs, None, instants * period, overrides))


@pytest.fixture
def short(monkeypatch):
    """Runs of more than 100 instants are long."""

    def of(whole=100, window=64, **more):
        for name, value in {"WHOLE": whole, "WINDOW": window, **more}.items():
            monkeypatch.setattr(long, name, value)

    return of


@pytest.mark.parametrize(
    ("robot", "estimators", "overrides"),
    [
        ("pendulum", ("ekf", "ukf"), ()),
        ("pendulum", ("ekf",), ("channels.encoder.latency=0.03", "bound=false")),
        ("pendulum", ("ekf",), ("channels.encoder.dropout=0.2",)),
        ("cartpole", ("ekf", "ckf"), ()),  # a reference estimator drives it
        ("cartpole", ("ekf",), ("process_noise.schedule=[[0.1, 1.0], [9.0, 1e15]]",)),  # breaks
        ("biped", ("ekf",), ("bound=false",)),  # phases of contact
    ],
)
def test_the_record_is_that_of_the_run_as_a_whole(robot, estimators, overrides, short):
    made = prepared(robot, estimators, 190, 2, overrides)
    whole = batch.run_batch(made, range(2), "summary")
    short(**ALL)
    assert long.windowed(made, "summary")
    np.testing.assert_array_equal(long.sampled(made, "summary"), np.arange(len(made.instants) + 1))
    found = batch.run_batch(made, range(2), "summary")
    assert found is not None
    assert whole is not None
    for label in estimators:
        for name, value in whole.records[label].items():
            if name != "cpu_time":
                other = found.records[label][name]
                assert other.dtype == value.dtype, name
                np.testing.assert_allclose(other, value, rtol=1e-9, err_msg=name)


def test_what_needs_the_whole_run_gets_it(short):
    short()
    assert long.windowed(prepared("pendulum"), "summary")
    assert not long.windowed(prepared("pendulum"), "diagonal")
    assert not long.windowed(prepared("pendulum", instants=90), "summary")
    assert not long.windowed(prepared("pendulum", ("rts",)), "summary")
    assert not long.windowed(
        prepared("pendulum", overrides=("channels.encoder.latency=0.03",)), "summary"
    )
    assert not long.windowed(
        prepared("cartpole", overrides=('control.observe="estimate"',)), "summary"
    )


def test_it_stops_when_asked(short):
    short()
    asked = iter([False] * 150 + [True] * 1000)
    assert batch.run_batch(prepared("pendulum"), range(2), "summary", lambda: next(asked)) is None


def test_a_store_has_a_sample_of_the_times(short, tmp_path):
    short(SAMPLE=20)
    period = build(resolve("pendulum", "ekf")).plant.period
    found = run("pendulum", "ekf", runs=2, duration=300 * period, keep="summary",
                out=tmp_path / "a")  # fmt: skip
    stored = load(tmp_path / "a")
    kept = [*range(0, 300, 17), 300]
    np.testing.assert_allclose(stored.times, period * np.array(kept))
    np.testing.assert_array_equal(found.times, stored.times)
    assert stored.instants == found.instants == 300
    assert found.length == "300 steps"
    assert stored.summaries["ekf"].cost == found["ekf"].cost
    assert stored.records["ekf"]["nees_sum"].shape == (1, len(kept))
    again = run("pendulum", "ekf", runs=3, duration=300 * period, keep="summary",
                out=tmp_path / "a", resume=True)  # fmt: skip
    assert len(again.runs) == 3
    short(SAMPLE=10)
    with pytest.raises(StoreError, match="other instants"):
        Store.reopen(tmp_path / "a", prepared("pendulum", instants=300, runs=3))


def test_the_memory_does_not_grow_with_the_length(short):
    short(whole=200, window=64, SAMPLE=50)
    peaks, forecasts = [], []
    for instants in (300, 900):
        made = prepared("pendulum", instants=instants, runs=1, overrides=("bound=false",))
        tracemalloc.start()
        batch.run_batch(made, range(1), "summary")
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        forecasts.append(batch.held_bytes(made, "summary", 1))
    assert (peaks[1] - peaks[0]) / 600 < 200  # bytes per instant; 840 for a run as a whole
    assert (forecasts[1] - forecasts[0]) / 600 < 100


def test_a_reference_that_fails(short):
    breaks = "control.estimator=tests.experiment.test_recording:Breaking"
    made = prepared("cartpole", ("ekf",), 130, 3, (breaks,))
    whole = batch.run_batch(made, range(3), "summary")
    short(**ALL)
    found = batch.run_batch(made, range(3), "summary")
    assert found is not None
    assert whole is not None
    record, other = found.records["ekf"], whole.records["ekf"]
    assert record["fault"].tolist() == [Fault.NONE, Fault.REFERENCE, Fault.NONE]
    for name in ("fault", "fault_step", "diverged", "count", "anees"):
        np.testing.assert_allclose(record[name], other[name], err_msg=name)
