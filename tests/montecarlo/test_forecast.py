"""Forecasts: what is said before a computation that takes long, and how true it is."""

import time
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from estbench.experiment import setup, unseen
from estbench.montecarlo import batch, forecast
from estbench.scenario.load import resolve

GRID = """<mujoco><extension><plugin plugin="mujoco.sensor.touch_grid"/></extension><worldbody>
<body><joint name="z" type="slide" axis="0 0 1"/><geom size=".1" mass="1"/><site name="pad"/></body>
</worldbody><sensor><jointpos name="encoder" joint="z" noise=".01"/>
<plugin name="grid" plugin="mujoco.sensor.touch_grid" objtype="site" objname="pad">
<config key="size" value="60 60"/><config key="fov" value="40 40"/><config key="gamma" value="0"/>
<config key="nchannel" value="1"/></plugin></sensor></mujoco>"""


def prepared(*arguments, **options):
    return setup.build(resolve(*arguments, **options))


def test_short_runs_are_not_measured():
    found = forecast.forecast(prepared("pendulum"), 50, 25, "summary", 2)
    assert found.seconds == 0
    assert not found.line


def test_forecast_of_a_long_computation_is_its_cpu_time():
    made = prepared("quadrotor", "ekf", runs=12, duration=0.3)
    found = forecast.forecast(made, 100_000, 12, "summary", 1)
    assert "this will take about" in found.line
    steps = len(made.instants)
    assert found.seconds == pytest.approx(100_000 * steps * found.step)
    began = time.process_time()
    list(batch.traced(made, range(12), bounded=True))
    taken = (time.process_time() - began) / (12 * steps)
    assert taken / 4 < found.step < 4 * taken


def test_a_batch_is_not_measured_for_a_robot_whose_single_step_is_slow(monkeypatch):
    """One step of one run is known after 10 of them; a batch would take 64 more."""
    asked = []

    def seconds(prepared, rows, instants):
        asked.append(rows * instants)
        return np.array([0.1, 0.1]) * rows * instants

    monkeypatch.setattr(forecast, "_seconds", seconds)
    found = forecast.forecast(prepared("quadrotor", "ekf"), 100_000, 12, "summary", 1)
    assert found is not None
    assert found.step == pytest.approx(0.2)
    assert sum(asked) == 10


def test_workers_beyond_the_cpus_share_them(monkeypatch):
    made = prepared("quadrotor", "ekf")
    monkeypatch.setattr(forecast, "_step", lambda made, rows, *_: np.array([5e-5, 5e-5]) * rows)
    monkeypatch.setattr(forecast.executors, "cpu_count", lambda: 2)
    two, eight = (forecast.forecast(made, 100_000, 12, "summary", n) for n in (2, 8))
    assert eight.seconds == two.seconds == 100_000 * len(made.instants) * two.step / 2


def test_a_sensor_of_thousands_of_values_is_named_only_where_it_is_in_use(tmp_path):
    path = tmp_path / "grid.xml"
    path.write_text(GRID)
    made = prepared(str(path), "ekf", runs=10)
    size = batch.default_batch_size(made, "summary")
    assert size * batch.working_bytes(made) <= batch.WORKING_BYTES
    first, second = forecast.lines(made, size, "summary", 2)
    assert "grid has 3600 values" in first
    assert "this will take about" in second
    spared = prepared(str(path), "ekf", runs=10, overrides=['sensors=["encoder"]'])
    assert forecast.lines(spared, 10, "summary", 2) == []


def test_memory_is_bounded_by_smaller_batches_only_for_wide_measurements():
    made = prepared("pendulum", runs=1000)
    assert batch.default_batch_size(made, "summary") == 250
    assert batch.working_bytes(made) < batch.WORKING_BYTES / 250


def test_coordinates_that_no_sensor_sees_are_named():
    made = prepared("cartpole")
    assert unseen.notice(made) == ""
    blind = prepared("cartpole", overrides=['sensors=["pole_encoder"]'])
    assert unseen.notice(blind).startswith("no sensor can see cart")
    exact = replace(blind, initial=replace(blind.initial, factor=0.0 * blind.cov))
    assert unseen.notice(exact) == ""


@pytest.mark.parametrize("label", ["ekf", "rts"])
def test_the_memory_is_what_a_batch_takes(label):
    made = prepared("pendulum", label, runs=50, duration=0.8, overrides=["bound=false"])
    batch.run_batch(replace(made, instants=made.instants[:3]), range(2), "summary")  # imports
    tracemalloc.start()
    batch.run_batch(made, range(50), "summary")
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most / 2 < batch.held_bytes(made, "summary", 50) < 2 * most


def test_a_batch_has_no_more_runs_than_there_are():
    made = prepared("pendulum", runs=1, duration=0.8)
    assert forecast.forecast(made, 1, 10, "summary", 2).memory == batch.held_bytes(
        made, "summary", 1
    )


def test_one_batch_is_the_work_of_one_worker(monkeypatch):
    monkeypatch.setattr(forecast, "_SHORT", 0)
    monkeypatch.setattr(forecast, "_step", lambda made, rows, *_: np.array([1e-6, 1e-6]) * rows)
    monkeypatch.setattr(forecast.executors, "cpu_count", lambda: 4)
    made = prepared("pendulum", runs=20, duration=0.8)
    one, two = (forecast.forecast(made, 20, size, "summary", 4) for size in (20, 10))
    assert one.seconds == pytest.approx(2 * two.seconds)


def test_what_does_not_fit_is_said_before_it_starts(monkeypatch):
    long = "estimators={rts={}}"
    made = prepared("pendulum", None, runs=250, duration=100.0, overrides=[long])
    windowed = prepared(
        "pendulum", None, runs=250, duration=100.0, overrides=["estimators={rts={window=1.0}}"]
    )
    assert batch.held_bytes(windowed, "summary", 250) < 0.8 * batch.held_bytes(made, "summary", 250)
    monkeypatch.setattr(forecast, "free_memory", lambda: 2**30)
    monkeypatch.setattr(forecast, "_step", lambda made, rows, *_: np.array([5e-7, 5e-7]) * rows)
    assert "1 GiB are free: it may not fit; --keep summary" in "".join(
        forecast.lines(made, 250, "summary", 2)
    )
    monkeypatch.setattr(forecast, "free_memory", lambda: 2**40)
    assert not forecast.lines(made, 250, "summary", 2)
