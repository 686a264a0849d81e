"""Channels that are not one sensor, through the whole filter: several together, or a function."""

from typing import Any

import numpy as np
import pytest

from estbench.estimators import registry
from estbench.experiment import setup
from estbench.inference.event_loop import run_filter
from estbench.montecarlo import run as experiment
from estbench.robots.library import engine
from estbench.sensors.delivery import divided
from estbench.simulation.sources import Recorded, Trajectory
from tests.helpers import simulated

RUNS = 5
CORRELATED = [[0.01, 0.0, 0.0, 0.008], [0, 0.01, 0, 0], [0, 0, 0.01, 0], [0.008, 0, 0, 0.04]]


def cart(x, u, t):
    return x[..., :1]


def prepare(*overrides):
    return setup.build(experiment.resolve("cartpole_imu", duration=0.5, overrides=overrides))


def run(prepared, trajectory, kind) -> Any:
    prior = np.tile(prepared.mean, (RUNS, 1)), np.tile(prepared.cov, (RUNS, 1, 1))
    with engine():
        return run_filter(
            registry.create(kind, {}, prepared.model()), prepared.space, prior,
            Recorded(prepared.instants, trajectory), prepared.channel_spaces, keep_cov=True,
        )  # fmt: skip


@pytest.mark.parametrize("kind", ["ekf", "ukf"])
def test_sensors_taken_together_are_fused_as_they_are_apart(kind):
    apart = prepare()
    together = prepare(
        "sensors=['cart_encoder', 'imu']", "channels.imu.of=['accel', 'gyro']",
        "channels.imu.noise=[0.2, 0.2, 0.2, 0.02, 0.02, 0.02]",
    )  # fmt: skip
    trajectory = simulated(apart, RUNS)
    assert [c.name for c in together.channels] == ["cart_encoder", "imu"]

    def joined(arrived):
        encoder, accel, gyro = divided(arrived)
        y = np.concatenate([accel.y, gyro.y], axis=1)
        return [encoder, accel._replace(channels=("imu",), y=y)]

    joint = Trajectory(trajectory.x, trajectory.u, [joined(a) for a in trajectory.deliveries])
    one, other = run(apart, trajectory, kind), run(together, joint, kind)
    np.testing.assert_allclose(other.mean, one.mean, rtol=0, atol=1e-12)
    np.testing.assert_allclose(other.cov, one.cov, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(other.dof, one.dof)


def test_the_filter_knows_how_the_noise_of_sensors_taken_together_goes_together():
    imu = f"channels.imu={{of=['gyro', 'cart_encoder'], cov={CORRELATED}}}"
    prepared = prepare("sensors=['accel', 'imu']", imu)
    np.testing.assert_array_equal(prepared.model().measurement_noise(0.0, ["imu"]), CORRELATED)
    trajectory = simulated(prepared, RUNS)
    simulator, imu = prepared.simulator(range(RUNS)), prepared.channels[-1]
    noise = []
    with engine():
        for k, arrived in enumerate(trajectory.deliveries):
            t = prepared.instants[k].end
            clean = simulator.suite.clean([imu], t, trajectory.x[k + 1], trajectory.u[k])
            noise += [d.y - clean for d in divided(arrived) if d.channels == ("imu",)]
    first, last = np.concatenate(noise)[:, [0, 3]].T
    # Correlation 0.4 of 250 pairs: Fisher's z has a std of 1/sqrt(247); refused below 1e-6.
    z = np.arctanh(np.corrcoef(first, last)[0, 1])
    assert abs(z - np.arctanh(0.008 / (0.1 * 0.2))) < 5 / np.sqrt(first.size - 3)


@pytest.mark.parametrize("kind", ["ekf", "ukf"])
def test_a_function_of_the_state_is_fused_as_the_sensor_it_imitates(kind):
    sensor = prepare("sensors=['accel', 'gyro', 'cart_encoder']")
    function = prepare(
        "sensors=['accel', 'gyro', 'cart']",
        f"channels.cart={{function='{__name__}:cart', unit='m', noise=0.01}}",
    )
    trajectory = simulated(sensor, RUNS)

    def imitated(arrived):
        (encoder,) = (d for d in divided(arrived) if d.channels == ("cart_encoder",))
        rest = [d for d in divided(arrived) if d is not encoder]
        return [*rest, encoder._replace(channels=("cart",))]

    other = Trajectory(trajectory.x, trajectory.u, [imitated(a) for a in trajectory.deliveries])
    one, two = run(sensor, trajectory, kind), run(function, other, kind)
    np.testing.assert_allclose(two.mean, one.mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(two.cov, one.cov, rtol=0, atol=1e-9)
    assert np.abs(one.error[-1, :, 0]).max() < 0.05
