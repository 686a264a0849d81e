"""Late readings: the exact handling, the naive one, the window, and what they cost."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from estbench.estimators import registry
from estbench.estimators.ekf import EKF
from estbench.experiment import setup
from estbench.inference.event_loop import run_filter
from estbench.inference.fusion import Delays
from estbench.montecarlo import run as experiment
from estbench.robots.library import engine
from estbench.sensors.delivery import divided
from estbench.simulation.sources import Recorded, Trajectory
from tests.helpers import simulated

RUNS = 6
# Two rates that split the filter's steps, one channel with gaps, one with jitter.
QUADROTOR = (
    "channels.position.rate=20", "channels.position.dropout=0.3", "channels.attitude.rate=25",
    "channels.attitude.jitter=0.01", "channels.gyro.dropout=0.1", "channels.gyro.dropout_length=3",
)  # fmt: skip
CARTPOLE = (
    "channels.cart_encoder.rate=50", "channels.pole_encoder.dropout=0.2", "model.frame_skip=3",
)  # fmt: skip
SCENARIOS = {"quadrotor": QUADROTOR, "cartpole": CARTPOLE, "cartpole_imu": ()}


@cache
def recorded(name="quadrotor", *overrides):
    overrides = (*SCENARIOS[name], *overrides)
    prepared = setup.build(experiment.resolve(name, duration=0.4, overrides=overrides))
    return prepared, simulated(prepared, RUNS)


def of_rows(delivery, rows):
    due, mask = delivery.due, delivery.mask
    return delivery._replace(
        due=due if isinstance(due, int) else due[rows], y=delivery.y[rows],
        mask=None if mask is None else mask[rows],
    )  # fmt: skip


def due(delivery):
    """The tick at which the readings that come were due: the same for all of them."""
    (tick,) = set(np.broadcast_to(delivery.due, len(delivery.y))[delivery.mask].ravel().tolist())
    return tick


def run(prepared, trajectory, kind="ekf", rows=slice(None), **delays) -> Any:
    runs = trajectory.x[:, rows].shape[1]
    if rows != slice(None):
        trajectory = Trajectory(
            trajectory.x[:, rows], trajectory.u[:, rows],
            [[of_rows(d, rows) for d in divided(arrived)] for arrived in trajectory.deliveries],
        )  # fmt: skip
    estimator = registry.create(kind, {}, prepared.model())
    prior = np.tile(prepared.mean, (runs, 1)), np.tile(prepared.cov, (runs, 1, 1))
    source = Recorded(prepared.instants, trajectory)
    with engine():
        return run_filter(
            estimator, prepared.space, prior, source, prepared.channel_spaces, keep_cov=True,
            delays=Delays(**delays),
        )  # fmt: skip


def retimed(trajectory, latency, silent=0):
    """The trajectory with its readings arriving `latency(channel, instant, runs)` instants late.

    They must be on time in the trajectory. None are taken in the last `silent` instants, so that
    all arrive.
    """
    count = len(trajectory.deliveries)
    deliveries = [[] for _ in range(count)]
    for k, arrived in enumerate(trajectory.deliveries[: count - silent]):
        for d in divided(arrived):
            late = latency(d.channels[0], k, d.y.shape[0])
            mask = np.ones(len(late), bool) if d.mask is None else d.mask
            for steps in np.unique(late[mask]):
                now = mask & (late == steps)
                if k + steps < count:
                    packet = d._replace(mask=None if now.all() else now)
                    deliveries[k + int(steps)].append(packet)
    return Trajectory(trajectory.x, trajectory.u, deliveries)


def fixed(steps) -> Any:
    return lambda channel, k, runs: np.full(runs, steps.get(channel, 0))


def scattered(largest, seed=0):
    rng = np.random.default_rng(seed)
    return lambda channel, k, runs: rng.integers(0, largest + 1, runs)


def window(prepared, instants):
    return sum(i.nstep for i in prepared.instants[-instants:]) + 20


def count(trajectory, prepared):
    """Numbers that arrive, per run `(run,)`."""
    total = np.zeros(trajectory.x.shape[1], int)
    for arrived in trajectory.deliveries:
        for d in divided(arrived):
            mask = np.ones(len(d.y), bool) if d.mask is None else d.mask
            total = total + prepared.channel_spaces[d.channels[0]].n * mask
    return total


# Exact: once everything has arrived, the posterior is that of readings that were on time

LATE = {
    "fixed": lambda: fixed({"position": 16, "pole_encoder": 7, "gyro": 3}),
    "several": lambda: fixed({"position": 16, "attitude": 5, "cart_encoder": 4, "accel": 9}),
    "random": lambda: scattered(9),
}


@pytest.mark.parametrize("late", LATE)
@pytest.mark.parametrize(
    ("name", "kind"),
    [("quadrotor", "ekf"), ("quadrotor", "ukf"), ("cartpole", "ekf"), ("cartpole", "ukf"),
     ("cartpole_imu", "sr_ukf"), ("cartpole_imu", "iekf")],
)  # fmt: skip
def test_exact_handling_gives_the_posterior_of_readings_on_time(name, kind, late):
    prepared, trajectory = recorded(name)
    on_time = run(prepared, retimed(trajectory, fixed({}), 20), kind, window=window(prepared, 20))
    delayed = retimed(trajectory, LATE[late](), 20)
    caught_up = run(prepared, delayed, kind, window=window(prepared, 20))
    assert not caught_up.late.any()
    assert not caught_up.fault.any()
    # Some runs are updated without the others, which rounds otherwise; forward differences (step
    # 1e-6) magnify that.
    np.testing.assert_allclose(caught_up.mean[-1], on_time.mean[-1], atol=1e-8, rtol=0)
    np.testing.assert_allclose(caught_up.cov[-1], on_time.cov[-1], atol=1e-9, rtol=0)
    np.testing.assert_array_equal(caught_up.dof, on_time.dof)
    np.testing.assert_allclose(caught_up.nis, on_time.nis, rtol=1e-6)
    # It did something: before it had caught up it knew less.
    assert np.abs(caught_up.mean - on_time.mean).max() > 1e-4


@pytest.mark.parametrize("kind", ["ekf", "ukf"])
def test_at_any_time_it_is_the_posterior_of_what_has_arrived_by_then(kind):
    prepared, trajectory = recorded()
    late = retimed(trajectory, scattered(9))
    handled = run(prepared, late, kind, window=window(prepared, 20))
    places = {instant.tick: k for k, instant in enumerate(prepared.instants)}
    for k in (15, 40, 70):
        known = [[] for _ in late.deliveries]
        for arrived in late.deliveries[: k + 1]:
            for d in divided(arrived):
                known[places[d.taken]].append(d)
        then = Trajectory(late.x[: k + 2], late.u[: k + 1], known[: k + 1])
        shorter = replace(prepared, instants=prepared.instants[: k + 1])
        expected = run(shorter, then, kind)
        atol = 1e-9 if kind == "ukf" else 1e-8  # forward differences magnify rounding errors
        np.testing.assert_allclose(handled.mean[k + 1], expected.mean[-1], atol=atol, rtol=0)
        np.testing.assert_allclose(handled.cov[k + 1], expected.cov[-1], atol=1e-9, rtol=0)


@pytest.mark.parametrize("rows", [slice(0, 1), slice(2, 5)])
@pytest.mark.parametrize("kind", ["ekf", "ukf"])
def test_a_run_is_handled_the_same_alone_and_among_others(kind, rows):
    prepared, trajectory = recorded()
    late = retimed(trajectory, scattered(9), 10)
    together = run(prepared, late, kind, window=6)
    alone = run(prepared, late, kind, rows, window=6)
    assert together.late.any()
    # What arrives in other runs makes an update larger, and rounds it otherwise; the EKF's forward
    # differences (step 1e-6) magnify that.
    atol = 1e-9 if kind == "ukf" else 1e-8
    np.testing.assert_allclose(alone.mean, together.mean[:, rows], atol=atol, rtol=0)
    np.testing.assert_allclose(alone.cov, together.cov[:, rows], atol=atol, rtol=0)
    np.testing.assert_allclose(alone.nis, together.nis[:, rows], rtol=1e-6)
    np.testing.assert_array_equal(alone.dof, together.dof[:, rows])
    np.testing.assert_array_equal(alone.late, together.late[rows])
    np.testing.assert_allclose(alone.lag_one, together.lag_one[rows], atol=1e-6)


def test_every_reading_is_fused_once():
    prepared, trajectory = recorded()
    for late in (fixed({"position": 16, "attitude": 5}), scattered(18)):
        delayed = retimed(trajectory, late)
        expected = count(delayed, prepared)
        assert len(set(expected)) > 1  # dropout
        for handling in ("exact", "naive"):
            traces = run(prepared, delayed, handling=handling, window=window(prepared, 20))
            np.testing.assert_array_equal(traces.dof.sum(axis=0), expected)
            assert not traces.late.any()


# End to end: a scenario with latency against the same one without


@pytest.mark.parametrize("kind", ["ekf", "ukf"])
def test_a_scenario_with_latency_catches_up_with_the_one_without(kind):
    """A position fix every 100 ms, 80 ms late: caught up in the last 15 ms before the next."""
    # The truth must not depend on the latency: the controller sees no estimate.
    settings = (
        "channels.position.rate=10", "channels.position.dropout=0.0", "control.observe=truth",
    )  # fmt: skip
    on_time, late = (
        run(*recorded("quadrotor", *settings, *more), kind, window=20)
        for more in ((), ("channels.position.latency=0.08",))
    )
    times = recorded("quadrotor", *settings)[0].times
    caught_up = (np.round(times / 0.005).astype(int) % 20 >= 16) | (times < 0.099)
    np.testing.assert_allclose(
        late.mean[caught_up], on_time.mean[caught_up], atol=1e-9, rtol=0
    )  # fmt: skip
    np.testing.assert_allclose(late.cov[caught_up], on_time.cov[caught_up], atol=1e-9, rtol=0)
    assert np.abs(late.mean - on_time.mean)[~caught_up].max() > 1e-3


def test_a_batch_of_everything_is_the_same_at_any_size():
    every = (
        "{bias=0.01,bias_walk=0.01,drift=0.01,scale_factor=0.01,quantization=0.001,cutoff=3.0,"
        "deadband=0.001,outlier_probability=0.05,student_dof=5.0,dropout=0.2,stuck=0.01,"
        "dropout_length=2.0,latency=0.01,latency_std=0.02,rate=25.0,jitter=0.01}"
    )
    overrides = [f"channels.{name}={every}" for name in ("cart_encoder", "pole_encoder")]
    overrides += ["filter.window=0.03", "model.timestep=0.005", "simulation.runs=7"]
    results = [
        experiment.run(
            "cartpole", ["ekf", "ukf"], duration=1.0, overrides=overrides, batch_size=size
        )
        for size in (7, 3, 1)
    ]
    for label, whole in results[0].records.items():
        assert whole["late"].any()
        for other in results[1:]:
            for name in ("anees", "anis", "mse", "variance", "late", "diverged", "fault"):
                np.testing.assert_allclose(
                    other.records[label][name], whole[name], rtol=1e-7, err_msg=name
                )
            np.testing.assert_allclose(
                [s.lag_one.value for s in other.summaries],
                [s.lag_one.value for s in results[0].summaries], rtol=1e-6,
            )  # fmt: skip


def test_equal_rates_are_the_single_rate_result_bit_for_bit():
    plain, trajectory = recorded("cartpole_imu")
    rates = [f"channels.{name}.rate=100" for name in ("cart_encoder", "accel", "gyro")]
    equal, same = recorded("cartpole_imu", *rates)
    assert equal.instants == plain.instants
    for a, b in zip(same.deliveries, trajectory.deliveries):
        assert [d.channels for d in a] == [d.channels for d in b]
        for d, e in zip(a, b):
            np.testing.assert_array_equal(d.y, e.y)
    for kind in ("ekf", "ukf"):
        one, other = run(plain, trajectory, kind), run(equal, same, kind)
        np.testing.assert_array_equal(one.mean, other.mean)
        np.testing.assert_array_equal(one.cov, other.cov)
        np.testing.assert_array_equal(one.nis, other.nis)


# The window


def test_what_is_older_than_the_window_is_counted_and_not_fused():
    prepared, trajectory = recorded("cartpole_imu")
    steps = {"accel": 6, "gyro": 5}
    delayed = retimed(trajectory, fixed(steps))
    ticks = 5  # one physics step an instant
    handled = run(prepared, delayed, window=ticks)
    arrived = sum(d.channels == ("accel",) for a in delayed.deliveries for d in divided(a))
    assert arrived > 10
    np.testing.assert_array_equal(handled.late, arrived)
    without = [
        [d for d in divided(arrived) if d.channels != ("accel",)] for arrived in delayed.deliveries
    ]
    deaf = run(prepared, Trajectory(delayed.x, delayed.u, without), window=ticks)
    assert not deaf.late.any()
    np.testing.assert_array_equal(handled.mean, deaf.mean)
    np.testing.assert_array_equal(handled.cov, deaf.cov)
    np.testing.assert_array_equal(handled.dof, deaf.dof)


def test_the_default_window_holds_every_fixed_latency():
    for skip in (1, 3):
        settings = ("channels.accel.latency=0.05", "channels.gyro.latency=0.033",
                    f"model.frame_skip={skip}")  # fmt: skip
        prepared, trajectory = recorded("cartpole_imu", *settings)
        traces = run(prepared, trajectory, window=prepared.window)
        assert not traces.late.any()
        np.testing.assert_array_equal(traces.dof.sum(axis=0), count(trajectory, prepared))


def test_without_a_window_only_current_readings_are_fused():
    prepared, trajectory = recorded("cartpole_imu")
    traces = run(prepared, retimed(trajectory, fixed({"gyro": 1})), window=0)
    assert (traces.late == len(prepared.instants) - 1).all()
    assert set(np.unique(traces.dof)) == {4}


# Naive, and wrong beliefs


def test_naive_handling_takes_a_late_reading_for_a_current_one():
    prepared, trajectory = recorded("cartpole_imu")
    delayed = retimed(trajectory, fixed({"accel": 4}))
    naive = run(prepared, delayed, handling="naive", window=50)
    shifted = [
        [d._replace(due=instant.tick, taken=instant.tick) for d in divided(arrived)]
        for instant, arrived in zip(prepared.instants, delayed.deliveries)
    ]
    expected = run(prepared, Trajectory(delayed.x, delayed.u, shifted))
    np.testing.assert_array_equal(naive.mean, expected.mean)
    np.testing.assert_array_equal(naive.nis, expected.nis)


def test_two_readings_of_one_channel_that_come_together_are_both_fused():
    prepared, trajectory = recorded("cartpole_imu")
    held = [[] for _ in trajectory.deliveries]
    for k, arrived in enumerate(trajectory.deliveries):
        held[min(2 * (k // 2) + 1, len(held) - 1)] += arrived
    naive = run(prepared, Trajectory(trajectory.x, trajectory.u, held), handling="naive")
    np.testing.assert_array_equal(naive.dof[0::2], 0)
    np.testing.assert_array_equal(naive.dof[1::2], 14)
    assert np.isnan(naive.nis[0::2]).all()


def test_a_filter_that_knows_the_latency_but_sees_no_timestamp():
    prepared, trajectory = recorded("cartpole_imu")
    delayed = retimed(trajectory, fixed({"accel": 4}))
    told = run(prepared, delayed, window=10)
    knows = run(prepared, delayed, window=10, believed={"accel": 4})
    np.testing.assert_array_equal(told.mean, knows.mean)
    wrong = run(prepared, delayed, window=10, believed={"accel": 2})
    shifted = [
        [
            d._replace(taken=instant.tick - 2) if d.channels == ("accel",) else d
            for d in divided(arrived)
        ]
        for instant, arrived in zip(prepared.instants, delayed.deliveries)
    ]
    expected = run(prepared, Trajectory(delayed.x, delayed.u, shifted), window=10)
    np.testing.assert_array_equal(wrong.mean, expected.mean)
    assert np.abs(wrong.mean - told.mean).max() > 1e-4


def test_a_reading_with_jitter_carries_the_time_it_was_taken_or_was_due():
    prepared, trajectory = recorded()
    taken = run(prepared, trajectory, window=10)
    planned = run(prepared, trajectory, window=10, nominal=frozenset({"attitude"}))
    apart = [d for arrived in trajectory.deliveries for d in divided(arrived) if due(d) != d.taken]
    assert apart
    assert {d.channels[0] for d in apart} == {"attitude"}
    np.testing.assert_array_equal(taken.dof.sum(axis=0), planned.dof.sum(axis=0))
    moved = [[d._replace(taken=min(due(d), instant.tick)) for d in divided(arrived)]
             for instant, arrived in zip(prepared.instants, trajectory.deliveries)]  # fmt: skip
    expected = run(prepared, Trajectory(trajectory.x, trajectory.u, moved), window=10)
    np.testing.assert_allclose(planned.mean, expected.mean, atol=1e-12)
    assert np.abs(planned.mean - taken.mean).max() > 1e-4


def test_the_scenario_says_it_all():
    prepared, _ = recorded(
        "cartpole_imu", "channels.gyro.latency=0.05", "filter.channels.gyro.latency=0.07",
        "filter.channels.accel.timestamps=due", "estimators.ekf={}",
        "estimators.late={type='ekf', delays='naive'}",
    )  # fmt: skip
    exact, naive = prepared.delays("ekf"), prepared.delays("late")
    assert (exact.handling, naive.handling) == ("exact", "naive")
    assert exact.believed == {"gyro": 7}
    assert exact.nominal == {"accel"}
    assert exact.window >= 7


# What it costs


class Counting(EKF):
    """An EKF that counts."""

    predicts = 0
    updates = 0

    def predict(self, belief, u, t, dt):
        type(self).predicts += 1
        return super().predict(belief, u, t, dt)

    def update(self, belief, y, u, t, channels=None, mask=None):
        type(self).updates += 1
        return super().update(belief, y, u, t, channels, mask)


@pytest.mark.parametrize("steps", [1, 5, 16])
def test_a_reading_that_is_d_steps_late_costs_d_predicts(steps):
    """Those from its time to now, the step's own among them."""
    prepared, trajectory = recorded("quadrotor", "channels.attitude.jitter=0.0")
    prior = np.tile(prepared.mean, (RUNS, 1)), np.tile(prepared.cov, (RUNS, 1, 1))
    counts = []
    for late in ({}, {"position": steps}):
        delayed = retimed(trajectory, fixed(late))
        Counting.predicts = Counting.updates = 0
        with engine():
            run_filter(
                Counting(prepared.model()), prepared.space, prior,
                Recorded(prepared.instants, delayed), prepared.channel_spaces,
                delays=Delays(window=window(prepared, 20)),
            )  # fmt: skip
        counts.append((Counting.predicts, Counting.updates))
    arrivals = sum(d.channels == ("position",) for a in delayed.deliveries for d in divided(a))
    assert counts[0][0] == len(prepared.instants)
    assert counts[1][0] - counts[0][0] == arrivals * (steps - 1)
    assert counts[1][1] - counts[0][1] <= arrivals * steps


# What is said of it


def test_late_readings_are_counted_in_the_results():
    late = ["channels.pole_encoder.latency=0.02", "channels.pole_encoder.latency_std=0.03",
            "filter.window=0.03"]  # fmt: skip
    results = experiment.run("cartpole", ["ekf"], runs=4, duration=0.5, overrides=late)
    count = int(results.records["ekf"]["late"].sum())
    assert count > 0
    assert results["ekf"].late == count
    assert results.to_dict()["estimators"]["ekf"]["late_readings"] == count
    note = f"note: ekf: {count} readings came later than filter.window and were not fused"
    assert note in str(results)
    punctual = experiment.run("cartpole", ["ekf"], runs=4, duration=0.5)
    assert punctual["ekf"].late == 0
    assert "were not fused" not in str(punctual)


def test_the_naive_filter_of_the_bundled_scenario_errs_more():
    results = experiment.run("quadrotor_delayed", runs=10, duration=1.0)
    exact, naive = (results.records[label]["anees"].mean() for label in ("ekf", "naive"))
    assert exact < 1.2  # the standard error is 0.08
    assert naive > exact + 0.05


def test_the_filter_that_knows_no_bias_is_overconfident():
    results = experiment.run("cartpole_bias", runs=40, duration=3.0)
    assert 0.85 < results["bias_ekf"].anees.value < 1.15
    assert str(results["ekf"].verdict) == "overconfident"
