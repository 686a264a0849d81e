"""Forecasts: what is said before a computation that takes long, and how true it is."""

import time
from dataclasses import replace

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
    assert forecast.forecast(prepared("pendulum"), 50, 25, "summary", 2) is None


def test_forecast_of_a_long_computation_is_its_cpu_time():
    made = prepared("quadrotor", "ekf", runs=12, duration=0.3)
    found = forecast.forecast(made, 100_000, 12, "summary", 1)
    assert found is not None
    assert "this will take about" in found.line
    steps = len(made.instants)
    assert found.seconds == pytest.approx(100_000 * steps * found.step)
    began = time.process_time()
    list(batch.traced(made, range(12), bounded=True))
    taken = (time.process_time() - began) / (12 * steps)
    assert taken / 4 < found.step < 4 * taken


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
