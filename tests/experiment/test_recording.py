"""One truth for all estimators, whose controller sees the reference estimator's estimate."""

from dataclasses import replace

import numpy as np
import pytest

import estbench
from estbench.consistency.scores import score
from estbench.errors import EstimatorError
from estbench.estimators.beliefs import Fault
from estbench.estimators.ekf import EKF
from estbench.experiment import setup
from estbench.experiment.recording import recorded, trajectory
from estbench.montecarlo.batch import traced
from estbench.scenario.load import resolve
from tests.stores import same

FAST = {"runs": 12, "duration": 0.3}
OWN = f"{__name__}:Breaking"


def prepared(name="cartpole", estimators=None, overrides=(), duration=0.3):
    return setup.build(resolve(name, estimators, overrides=overrides, duration=duration))


class Breaking(EKF):
    """An EKF that fails in run 1 of a batch when 0.1 s have passed."""

    def predict(self, belief, u, t, dt):
        moved = super().predict(belief, u, t, dt)
        if t > 0.095 and len(moved.mean) > 1:
            moved.mean[1] = np.nan
        return moved


@pytest.fixture(scope="module")
def base():
    """Three runs of the quadrotor with its own estimators."""
    return trajectory(prepared("quadrotor_delayed", duration=0.1), range(3))


@pytest.mark.parametrize(
    ("estimators", "overrides"),
    [
        (["naive"], []),
        (["ukf", "ekf"], []),
        (["ekf"], ["filter.process_noise_scale=100.0", "start.inflate=3.0", "filter.delays=naive"]),
        (["ukf"], ['filter.set."body_mass.frame"=0.9', "filter.channels.position.latency=0.0"]),
        (["enkf"], ["consistency.burn_in=0.05"]),
    ],
)
def test_no_estimator_and_no_setting_of_a_filter_changes_the_truth(estimators, overrides, base):
    other = trajectory(prepared("quadrotor_delayed", estimators, overrides, 0.1), range(3))
    np.testing.assert_array_equal(other.x, base.x)
    np.testing.assert_array_equal(other.u, base.u)
    for ours, theirs in zip(other.deliveries, base.deliveries):
        assert [d.channels for d in ours] == [d.channels for d in theirs]
        for a, b in zip(ours, theirs):
            np.testing.assert_array_equal(a.y, b.y)


def test_the_truth_of_a_run_is_the_same_in_any_batch():
    for name in ("cartpole_bias", "quadrotor_delayed"):
        experiment = prepared(name, duration=0.2)
        whole = trajectory(experiment, range(6))
        for runs in ([4], [3, 4]):
            some = trajectory(experiment, runs)
            np.testing.assert_array_equal(some.x, whole.x[:, runs])
            np.testing.assert_array_equal(some.u, whole.u[:, runs])


def test_the_controls_are_those_of_the_references_estimate():
    experiment = prepared(overrides=["control.estimator={type='ukf', alpha=0.5}"])
    truth, traces = recorded(experiment, range(4))
    controller = experiment.controller(range(4))
    for k in range(len(truth.u)):
        np.testing.assert_array_equal(truth.u[k], controller(k, 0.01 * k, traces.mean[k]))
    assert np.abs(traces.error[1:]).min() > 0.0  # it is not the truth that the controller saw


def test_the_reference_under_test_need_not_run_again(monkeypatch):
    """Its traces are those that it has as another estimator, to the bit."""
    shared = dict(traced(prepared(estimators=["ukf", "ekf"]), range(3), keep_cov=True))
    monkeypatch.setattr(setup.Setup, "is_reference", lambda self, label: False)
    apart = dict(traced(prepared(estimators=["ukf", "ekf"]), range(3), keep_cov=True))
    for label in ("ukf", "ekf"):
        for field in ("truth", "mean", "cov", "nees", "nis", "dof", "lags", "fault"):
            ours, theirs = getattr(shared[label], field), getattr(apart[label], field)
            np.testing.assert_array_equal(ours, theirs, err_msg=f"{label} {field}")


@pytest.mark.parametrize(
    ("overrides", "same_as"),
    [
        ([], True),
        (["estimators.ekf.covariance_update=simplified"], False),
        (["filter.measurement_noise_scale=2.0"], False),
        (["start.inflate=2.0"], False),
        (["control.estimator=ukf"], False),
    ],
)
def test_which_estimator_is_the_reference(overrides, same_as):
    experiment = prepared(estimators=["ekf", "ukf"], overrides=overrides)
    assert experiment.is_reference("ekf") is same_as
    assert not experiment.is_reference("ukf")  # it may be one that draws random numbers


def test_controls_that_depend_on_no_state_need_no_reference():
    for kind in ("none", "random", "sine"):
        experiment = prepared(overrides=[f"control={{kind='{kind}', observe='reference'}}"])
        assert experiment.reference is None
        x = trajectory(prepared(overrides=[f"control={{kind='{kind}'}}"]), range(2)).x
        np.testing.assert_array_equal(trajectory(experiment, range(2)).x, x)


def test_only_a_controller_that_sees_the_truth_is_warned_of():
    def leaks(*overrides):
        return any("sees the true state" in n for n in prepared(overrides=overrides).notices)

    assert leaks("control.observe=truth")
    assert not leaks()
    assert not leaks("control.observe=estimate")
    assert not leaks("control.observe=truth", "control.kind=random")


# A reference that fails


def test_a_run_whose_reference_fails_is_marked_and_the_others_survive():
    overrides = [f"control.estimator={OWN}"]
    broken = dict(traced(prepared(estimators=["ekf", "ukf"], overrides=overrides), range(3)))
    whole = dict(traced(prepared(estimators=["ekf", "ukf"]), range(3)))
    for label in ("ekf", "ukf"):
        traces = broken[label]
        assert traces.fault.tolist() == [Fault.NONE, Fault.REFERENCE, Fault.NONE]
        # The reference fails at the end of the step that begins at 0.1 s; that state is known.
        assert traces.fault_step.tolist() == [-1, 12, -1]
        assert np.isfinite(traces.nees[:12]).all()
        np.testing.assert_array_equal(traces.truth[:, [0, 2]], whole[label].truth[:, [0, 2]])
        np.testing.assert_array_equal(traces.nees[:, [0, 2]], whole[label].nees[:, [0, 2]])
    results = estbench.run("cartpole", ["ekf"], overrides=overrides, **FAST, batch_size=6)
    said = [(f.run, f.reason) for f in results["ekf"].failures]
    assert [run for run, _ in said] == [1, 7]
    assert said[0][1] == "the reference estimator, whose estimate the controller sees, failed"


def test_a_failed_simulation_is_not_the_references_fault():
    overrides = ["process_noise.schedule=[[0.1, 1.0], [9.0, 1e15]]"]
    for label, traces in traced(prepared("cartpole", ["ekf", "ukf"], overrides), range(2)):
        assert traces.fault.tolist() == [Fault.TRUTH] * 2, label


class Early(EKF):
    """An EKF whose estimates fail one step before a truth that explodes at 0.1 s."""

    def predict(self, belief, u, t, dt):
        moved = super().predict(belief, u, t, dt)
        return replace(moved, mean=np.full_like(moved.mean, np.nan)) if t > 0.075 else moved


def test_a_filter_that_fails_before_its_truth_is_not_called_diverging():
    overrides = ["process_noise.schedule=[[0.1, 1.0], [9.0, 1e15]]"]
    results = estbench.run("cartpole", [f"{__name__}:Early"], overrides=overrides, **FAST)
    summary = results["Early"]
    assert str(summary.verdict) == "simulation failed"
    assert {f.reason for f in summary.failures} == {Fault.TRUTH.text}
    assert all(f.time > 0.1 for f in summary.failures)
    assert "failed in 12 of 12 runs, first at 0.1" in summary.reason


class Careless(EKF):
    """Raises."""

    def predict(self, belief, u, t, dt):
        raise RuntimeError("no model")


def test_a_mistake_in_the_reference_names_it():
    for value, message in (
        ("{type='ekf', alpha=1.0}", "control.estimator: no setting 'alpha'"),
        ("rts", "control.estimator is .*rts.*, a smoother"),
        ("{type='ekf', delays='never'}", "control.estimator: delays is 'never'"),
    ):
        with pytest.raises(EstimatorError, match=message):
            prepared(overrides=[f"control.estimator={value}"])
    with pytest.raises(EstimatorError, match=r"^control\.estimator raised RuntimeError: no model"):
        estbench.run("cartpole", overrides=[f"control.estimator={__name__}:Careless"], **FAST)


# Stores


def test_shards_and_a_run_resumed_by_processes_give_the_store_of_one_run(tmp_path):
    def run(out, **more):
        return estbench.run("cartpole", ["ukf"], **FAST, batch_size=3, out=tmp_path / out, **more)

    whole = run("whole")
    for i in (1, 2):
        run("shards", shard=(i, 2))
    run("resumed", shard=(2, 3))
    run("resumed", resume=True, executor="processes", workers=1)
    for other in ("shards", "resumed"):
        same(tmp_path / "whole", tmp_path / other)
    with estbench.open_results(tmp_path / "whole") as tree:
        np.testing.assert_array_equal(
            np.swapaxes(tree["truth/x"].to_numpy(), 0, 1),
            trajectory(setup.build(whole.scenario), range(12)).x,
        )


def test_an_estimator_that_takes_a_late_fix_for_a_current_one_loses():
    """Issue 14: with the true state at the controller it has the smaller error (50 of 60 runs).

    The mean paired difference of log RMSE is 4.9 of its standard errors with this seed.
    """
    results = estbench.run("quadrotor_delayed", ["naive", "ekf"], runs=16, duration=1.5)
    naive, exact = (score(r["mse"], r["diverged"]) for r in results.records.values())
    worse = naive - exact
    assert worse.mean() > 3 * worse.std() / np.sqrt(len(worse))
