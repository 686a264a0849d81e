"""All sensors of many robots, each of which is somewhere else in its episode."""

import numpy as np
import pytest

from estbench.experiment import setup
from estbench.montecarlo import run as experiment
from estbench.sensors.delivery import divided

HERE = __name__
ROWS = 5


def beacon(x, u, t):
    """Of the cart from a beacon that wanders."""
    return np.stack([x[..., 0] - np.sin(3 * t), x[..., 0] * t], axis=-1)


FUNCTION = f"channels.beacon={{function='{HERE}:beacon', unit='m', noise=0.01}}"
IMU = ("sensors=['gyro', 'beacon', 'accel']", FUNCTION)


def suite(*overrides, rows=ROWS, look=False):
    prepared = setup.build(experiment.resolve("cartpole_imu", duration=0.5, overrides=overrides))
    return prepared, prepared.robots(rows, look=look).suite


def states(prepared):
    rng = np.random.default_rng(0)
    x = prepared.mean + 0.2 * rng.standard_normal((ROWS, prepared.space.nx))
    return x, 0.3 * rng.standard_normal((ROWS, 1))


@pytest.mark.parametrize("names", [("beacon",), ("gyro", "beacon", "accel"), ("gyro", "accel")])
def test_a_users_function_is_given_the_time_of_each_row(names):
    prepared, many = suite(*IMU)
    _, one = suite(*IMU, rows=1)
    x, u = states(prepared)
    channels = [c for c in prepared.channels if c.name in names]
    times = np.array([0.1, 0.37, 0.1, 0.0, 2.0])
    found = many.clean(channels, times[:, None], x, u)
    for row, t in enumerate(times):
        here = slice(row, row + 1)
        expected = one.clean(channels, float(t), x[here], u[here])
        np.testing.assert_array_equal(found[here], expected)
    same = many.clean(channels, 0.37, x, u)
    np.testing.assert_array_equal(same, many.clean(channels, np.full((ROWS, 1), 0.37), x, u))
    np.testing.assert_array_equal(same[1], found[1])


def test_readings_of_rows_on_different_clocks_are_of_their_own_time():
    slow = (*IMU, "channels.beacon.rate=25")
    prepared, many = suite(*slow)
    x, u = states(prepared)
    seed, began = prepared.scenario.simulation.seed, np.array([0, 0, 3, 5, 5])
    seen = [{} for _ in range(ROWS)]
    for tick in range(30):
        if tick:
            for d in divided(many.read(tick, (tick - began)[:, None] * 0.01, x, u)):
                for row in range(ROWS) if d.mask is None else np.flatnonzero(d.mask):
                    seen[row][d.channels[0], tick - began[row]] = d.y[row].tolist()
        rows = np.flatnonzero(began == tick)
        if len(rows):
            many.start(rows, seed, rows.tolist(), tick, x, u)
            assert not any(seen[row] for row in rows)
    for row in range(ROWS):
        here = slice(row, row + 1)
        _, one = suite(*slow, rows=1)
        one.start(np.arange(1), seed, [row], 0, x[here], u[here])
        expected = {
            (d.channels[0], tick): d.y[0].tolist()
            for tick in range(1, 30 - began[row])
            for d in divided(one.read(tick, tick * 0.01, x[here], u[here]))
        }
        assert {name for name, _ in expected} == {"gyro", "beacon", "accel"}
        assert seen[row] == expected


def test_a_look_is_the_start_and_what_arrives_follows():
    prepared, many = suite("channels.gyro.rate=25", look=True)
    x, u = states(prepared)
    many.start(np.arange(ROWS), 3, range(ROWS), 0, x, u)
    first = many.latest.copy()
    clean = many.clean(prepared.channels, 0.0, x, u)
    std = np.sqrt(np.concatenate([np.diag(c.cov) for c in prepared.channels]))
    error = many.space.minus(first, clean)
    assert (np.abs(error) < 6 * std).all()
    assert (error != 0).all()
    # The same look alone, whoever else begins; and nothing changes in the others.
    many.start(np.array([3]), 3, [3], 2, x, u)
    np.testing.assert_array_equal(many.latest, first)
    many.start(np.array([1]), 3, [8], 2, x, u)
    assert (many.latest[1] != first[1]).all()
    others = [0, 2, 3, 4]
    np.testing.assert_array_equal(many.latest[others], first[others])
    before = many.latest.copy()
    arrived = {d.channels[0]: d for d in divided(many.read(3, np.full((ROWS, 1), 0.03), x, u))}
    assert set(arrived) == {"cart_encoder", "accel"}
    start = 0
    for channel in prepared.channels:
        stop = start + channel.space.nx
        expected = before[:, start:stop]
        if channel.name in arrived:
            d = arrived[channel.name]
            came = np.ones(ROWS, bool) if d.mask is None else d.mask
            expected = np.where(came[:, None], d.y, expected)
        np.testing.assert_array_equal(many.latest[:, start:stop], expected)
        start = stop


def shy(x, u, t):
    """Two beacons, of which a cart beyond one side hears none, and beyond the other one only."""
    there = np.stack([x[..., 0], 2.0 * x[..., 0]], axis=-1)
    there = np.where(x[..., :1] > 1.0, np.inf, there)
    there[..., 1] = np.where(x[..., 0] < -1.0, np.inf, there[..., 1])
    return there


def shy_suite(*more, look=False):
    beacon = f"channels.beacon={{function='{HERE}:shy', unit='m', noise=0.01{''.join(more)}}}"
    prepared, sensors = suite("sensors=['beacon', 'gyro']", beacon, rows=3, look=look)
    x = np.repeat(prepared.mean[None], 3, axis=0)
    x[:, 0] = 2.0, 0.5, -2.0
    return prepared, sensors, x


IMPERFECT = ", bias=0.1, scale_factor=0.1, cutoff=3.0, quantization=0.001, stuck=0.1, latency=0.02"


@pytest.mark.parametrize("more", ["", IMPERFECT])
def test_a_component_without_a_return_does_not_arrive(more):
    """One row without any return, one with all, one with the first component only."""
    prepared, sensors, x = shy_suite(more)
    sensors.start(np.arange(3), 0, range(3), 0, x, np.zeros((3, 1)))
    period, seen = prepared.plant.nstep, 0
    for k in range(1, 6):
        t = k * prepared.plant.period
        for delivery in divided(sensors.read(k * period, t, x, np.zeros((3, 1)))):
            if delivery.channels == ("beacon",):
                seen += 1
                assert delivery.mask.tolist() == [False, True, True]
                assert np.isfinite(delivery.y).tolist() == [[False] * 2, [True] * 2, [True, False]]
    assert seen >= 3


def test_the_latest_reading_stays_where_there_is_no_return():
    """It is 0 before any return, and afterwards the last value that came."""
    prepared, sensors, x = shy_suite(look=True)
    u, period = np.zeros((3, 1)), prepared.plant.nstep
    sensors.start(np.arange(3), 0, range(3), 0, x, u)
    assert (sensors.latest[:, -2:] == 0.0).tolist() == [[True] * 2, [False] * 2, [False, True]]
    before = sensors.latest.copy()
    x[:, 0] = 2.0, 2.0, 0.5
    sensors.read(period, prepared.plant.period, x, u)
    assert sensors.latest[:2, -2:].tolist() == before[:2, -2:].tolist()
    np.testing.assert_allclose(sensors.latest[2, -2:], [0.5, 1.0], atol=0.06)
