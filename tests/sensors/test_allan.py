"""The Allan deviation of simulated sensors against their datasheets."""

import numpy as np
import pytest

from estbench.errors import EstbenchError
from estbench.experiment import setup
from estbench.montecarlo import run as experiment
from estbench.scenario.channels import ChannelSection
from estbench.sensors import allan
from estbench.sensors import channel as sensors
from tests.helpers import zoo_model


def gyro(**section):
    model = zoo_model("joints")  # 4 ms steps
    (channel,), _ = sensors.build(model, {"gyro": ChannelSection(**section)}, ["gyro"], 1)
    return channel


def textbook(values, m):
    """Second differences of the running means over m readings, one by one."""
    means = [np.mean(values[k : k + m]) for k in range(len(values) - m + 1)]
    steps = [means[k + m] - means[k] for k in range(len(means) - m)]
    return np.sqrt(np.mean(np.square(steps)) / 2)


def test_it_is_the_textbooks():
    values = np.random.default_rng(0).standard_normal((50, 2)).cumsum(axis=0)
    taus, found = allan.deviation(values, 0.1, [0.1, 0.3, 1.0, 2.5])
    np.testing.assert_allclose(taus, [0.1, 0.3, 1.0, 2.5])
    for tau, row in zip(taus, found):
        for axis in range(2):
            expected = textbook(values[:, axis], round(tau / 0.1))
            assert row[axis] == pytest.approx(expected, rel=1e-12)


def test_a_constant_and_a_ramp():
    taus, found = allan.deviation(np.full(100, 3.0), 0.5)
    np.testing.assert_allclose(found, 0.0, atol=1e-12)
    taus, found = allan.deviation(np.linspace(0.0, 99.0, 100), 0.5)
    np.testing.assert_allclose(found, 2.0 * taus / np.sqrt(2))  # IEEE 952: a rate ramp
    assert taus[0] == 0.5
    assert taus[-1] == 12.5


def assert_expected(channel, taus, duration, runs=64, axis=0):
    """The mean over runs of the Allan variance, at six of its standard errors a τ: 1e-7 each."""
    values = allan.at_rest(channel, duration, 1, runs)[..., axis]
    step = channel.timing.period * channel.timing.timestep
    found, square = allan.deviation(values, step, taus)
    square = square**2
    expected = allan.NoiseParameters.of(channel, axis).expected(found) ** 2
    error = square.std(axis=1) / np.sqrt(runs)
    assert (np.abs(square.mean(axis=1) - expected) < 6 * error).all()
    return found, np.sqrt(square.mean(axis=1))


def test_white_noise_has_its_density_at_one_second():
    taus, found = assert_expected(gyro(noise_density=0.002, rate=25), [0.04, 0.2, 1.0, 4.0], 60.0)
    np.testing.assert_allclose(found * np.sqrt(taus), 0.002, rtol=0.03)


def test_a_bias_walk_rises_with_the_root_of_time():
    channel = gyro(noise=1e-6, rate=25, bias_walk=0.03, bias=0.5)
    taus, found = assert_expected(channel, [1.0, 3.0, 10.0], 100.0)
    np.testing.assert_allclose(found, 0.03 * np.sqrt(taus / 3), rtol=0.15)


def test_a_gyro_of_a_datasheet():
    """0.001 rad/s/√Hz at short times; 0.664 of the bias instability at 1.89 correlation times."""
    channel = gyro(noise_density=0.001, rate=25, bias_instability=0.003, drift_time=5.0)
    peak = 1.89 * 5.0
    taus, found = assert_expected(channel, [0.04, 0.08, 0.4, 2.0, peak, 30.0], 200.0)
    assert found[0] * np.sqrt(taus[0]) == pytest.approx(0.001, rel=0.01)
    assert found[4] == pytest.approx(0.6643 * 0.003, rel=0.1)
    assert found[4] > found[5]


def test_a_record_comes_from_every_axis_of_every_run():
    values = allan.at_rest(gyro(noise=[0.1, 0.2, 0.3], rate=125), 1.0, runs=3)
    assert values.shape == (125, 3, 3)
    np.testing.assert_allclose(values.std(axis=(0, 1)), [0.1, 0.2, 0.3], rtol=0.25)


@pytest.mark.parametrize(
    "section", [{"dropout": 0.1}, {"latency": 0.1}, {"rate": 25, "jitter": 0.004}]
)
def test_gaps_and_delays_have_no_allan_deviation(section):
    with pytest.raises(EstbenchError, match="'gyro' has a quaternion, gaps, jitter or latency"):
        allan.at_rest(gyro(**section), 1.0)


@pytest.mark.parametrize(
    ("values", "taus", "message"),
    [
        (np.zeros(3), None, "has 3 readings; .* at least 4"),
        (np.zeros(100), [0.1, 60.0], r"from 0\.1 to 60 s; use 0\.1 to 5 s"),
        (np.zeros(100), [0.01], r"use 0\.1 to 5 s"),
    ],
)
def test_bad_records(values, taus, message):
    with pytest.raises(EstbenchError, match=message):
        allan.deviation(values, 0.1, taus)


def test_the_picture():
    pytest.importorskip("matplotlib")
    prepared = setup.build(experiment.resolve("cartpole_bias"))
    channel = next(c for c in prepared.channels if c.name == "gyro")
    figure = allan.plot(channel, 20.0, runs=2)
    (ax,) = figure.axes
    assert ax.get_title() == "gyro.y"
    assert ax.get_ylabel() == "Allan deviation (rad/s)"
    assert [t.get_text() for t in ax.get_legend().get_texts()] == ["simulated runs", "datasheet"]
    three = allan.plot(gyro(noise=0.1), 5.0, runs=2)
    assert [ax.get_title() for ax in three.axes] == ["gyro.x", "gyro.y", "gyro.z"]


def test_four_readings_are_enough():
    values = np.array([1.0, 3.0, 2.0, 6.0])
    taus, found = allan.deviation(values, 0.5)
    np.testing.assert_array_equal(taus, [0.5])
    # AVAR(τ) is half the mean square of the differences of neighbouring averages.
    np.testing.assert_allclose(found, np.sqrt(0.5 * np.mean(np.diff(values) ** 2)))
    taus, found = allan.deviation(values, 0.5, [1.0])
    np.testing.assert_allclose(found, np.sqrt(0.5 * (4.0 - 2.0) ** 2))
