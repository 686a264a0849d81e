import copy
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

import estbench
from estbench.errors import DimensionError, EstimatorError
from estbench.estimators.beliefs import Fault, GaussianEstimator
from estbench.estimators.ekf import EKF
from estbench.experiment import setup
from estbench.inference.event_loop import run_filter
from estbench.inference.initialization import WarmStart
from estbench.montecarlo import run as experiment
from estbench.randomness import streams
from estbench.robots.library import engine
from estbench.sensors.clock import Event
from estbench.simulation.sources import Live, Recorded, Trajectory
from tests.helpers import simulated

RUNS = 6


@cache
def recorded(name="cartpole", *overrides):
    """A setup, its source of recorded truth, and the prior of `RUNS` runs."""
    prepared = setup.build(experiment.resolve(name, duration=0.3, overrides=overrides))
    return prepared, simulated(prepared, RUNS)


def prior(prepared, runs=RUNS):
    return np.tile(prepared.mean, (runs, 1)), np.tile(prepared.cov, (runs, 1, 1))


def run(estimator, prepared, trajectory, **options):
    source = Recorded(prepared.instants, trajectory)
    with engine():
        return run_filter(
            estimator, prepared.space, prior(prepared), source, prepared.channel_spaces, **options
        )


def shaken(trajectory, run, step):
    """The trajectory with the truth of one run lost from one index on."""
    x, deliveries = trajectory.x.copy(), copy.deepcopy(trajectory.deliveries)
    x[step:, run] = np.nan
    for arrived in deliveries[step - 1 :]:
        for delivery in arrived:
            delivery.y[run] = np.nan
    return Trajectory(x, trajectory.u, deliveries)


# What is recorded


@pytest.mark.parametrize("name", ["cartpole", "quadrotor"])
def test_traces_are_those_of_a_loop_by_hand(name):
    prepared, trajectory = recorded(name)
    traces = run(EKF(prepared.model()), prepared, trajectory, keep_cov=True)
    ekf, space = EKF(prepared.model()), prepared.space
    belief = ekf.init(*prior(prepared))
    beliefs, innovations = [belief], []
    with engine():
        for k, instant in enumerate(prepared.instants):
            belief = ekf.predict(
                belief, trajectory.u[k], instant.start, instant.end - instant.start
            )
            if trajectory.deliveries[k]:
                y = np.concatenate([d.y for d in trajectory.deliveries[k]], axis=1)
                belief, innovation = ekf.update(
                    belief, y, trajectory.u[k], instant.end, instant.channels
                )
                np.testing.assert_array_equal(traces.nis[k], innovation.nis)
                np.testing.assert_array_equal(traces.dof[k], innovation.dof)
                innovations.append(innovation.white)
            beliefs.append(belief)
    assert len(traces.mean) == len(beliefs) == len(prepared.times)
    for k, belief in enumerate(beliefs):
        np.testing.assert_array_equal(traces.truth[k], trajectory.x[k])
        np.testing.assert_array_equal(traces.mean[k], belief.mean)
        np.testing.assert_array_equal(traces.cov[k], belief.cov)
        error = space.minus(trajectory.x[k], belief.mean)
        np.testing.assert_array_equal(traces.error[k], error)
        np.testing.assert_allclose(traces.std[k] ** 2, np.diagonal(belief.cov, axis1=1, axis2=2))
        nees = [e @ np.linalg.solve(P, e) for e, P in zip(error, belief.cov)]
        np.testing.assert_allclose(traces.nees[k], nees, rtol=1e-8)
    assert not traces.fault.any()
    assert (traces.fault_step == -1).all()
    assert traces.cpu_time > 0
    if name == "cartpole":  # all channels at every instant
        white = np.array(innovations)
        expected = (white[1:] * white[:-1]).mean(axis=(0, 2)) / (white**2).mean(axis=(0, 2))
        np.testing.assert_allclose(traces.lag_one, expected)


def test_nis_is_nan_and_dof_zero_where_nothing_arrives():
    prepared, trajectory = recorded("pendulum", "channels.encoder.rate=25", "channels.gyro.rate=50")
    traces = run(EKF(prepared.model()), prepared, trajectory)
    # 10 ms steps: three numbers of the gyro at every second, one of the encoder at every fourth.
    expected = [4 if k % 4 == 0 else 3 if k % 2 == 0 else 0 for k in range(1, 31)]
    np.testing.assert_array_equal(traces.dof, np.tile(expected, (RUNS, 1)).T)
    np.testing.assert_array_equal(np.isnan(traces.nis), traces.dof == 0)
    assert np.isfinite(traces.nees).all()


def test_lag_one_is_nan_without_two_readings_of_the_same_channels():
    overrides = ['sensors=["encoder"]', "channels.encoder.rate=5"]
    prepared, trajectory = recorded("pendulum", *overrides)
    assert np.isnan(run(EKF(prepared.model()), prepared, trajectory).lag_one).all()


def test_covariances_are_kept_only_when_asked_for():
    assert run(EKF(recorded()[0].model()), *recorded()).cov is None


def test_stopping_gives_nothing():
    asked = []

    def stop():
        asked.append(None)
        return len(asked) == 3

    assert run(EKF(recorded()[0].model()), *recorded(), stop=stop) is None
    assert len(asked) == 3


# Feedback from the estimate


def steered(prepared, controller):
    """`RUNS` robots under a controller."""
    simulator = prepared.simulator(range(RUNS))
    return Live(simulator, prepared.instants, controller, prepared.plant.period)


def test_live_asks_the_controller_with_the_estimate():
    prepared, _ = recorded()
    seen = []

    def controller(k, t, x):
        seen.append((k, t, x.copy()))
        return -2.0 * x[:, :1]

    live = steered(prepared, controller)
    with engine():
        traces = run_filter(
            EKF(prepared.model()), prepared.space, prior(prepared), live, prepared.channel_spaces
        )
    assert [k for k, *_ in seen] == list(range(30))
    np.testing.assert_allclose([t for _, t, _ in seen], prepared.times[:-1])
    np.testing.assert_array_equal([x for *_, x in seen], traces.mean[:-1])
    # The truth moved under that control, with the noise it would have had anyway.
    simulator = prepared.simulator(range(RUNS))
    np.testing.assert_array_equal(simulator.x, traces.truth[0])
    np.testing.assert_array_equal(simulator.x, recorded()[1].x[0])
    with engine():
        for k, instant in enumerate(prepared.instants):
            simulator.advance(Event(instant.tick, instant), -2.0 * traces.mean[k][:, :1])
            np.testing.assert_array_equal(simulator.x, traces.truth[k + 1])
    assert k == 29


def test_live_control_is_held_between_filter_steps():
    prepared, _ = recorded("cartpole", "channels.pole_encoder.rate=100", "model.frame_skip=3")
    asked = []

    def controller(k, t, x):
        asked.append(k)
        return np.full((RUNS, 1), float(k))

    live = steered(prepared, controller)
    held = [live.control(k, live.x0)[0, 0] for k in range(9)]
    assert held == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    assert asked == [0, 1, 2]


def test_live_never_shows_the_controller_a_failed_estimate():
    prepared, _ = recorded()
    seen = []

    def controller(k, t, x):
        seen.append(x.copy())
        return np.zeros((RUNS, 1))

    live = steered(prepared, controller)
    broken = Sabotage(prepared.model(), 4, lambda b: b.mean.__setitem__(2, np.nan))
    with engine():
        traces = run_filter(broken, prepared.space, prior(prepared), live, prepared.channel_spaces)
    assert np.isnan(traces.mean[4:, 2]).all()
    assert np.isfinite(seen).all()


# Estimators of all sorts


class Plain:
    """A textbook EKF for one's own use: no base class, no faults, plain tuples."""

    def __init__(self, model):
        self.model = model

    def init(self, mean, cov):
        return mean, cov

    def predict(self, belief, u, t, dt):
        x, P = belief
        f, F = self.model.transition_jacobian(x, u, t, dt)
        return f, F @ P @ F.swapaxes(1, 2) + self.model.process_noise(x, u, t, dt)

    def update(self, belief, y, u, t, channels=None, mask=None):
        x, P = belief
        h, H = self.model.measurement_jacobian(x, u, t, channels)
        S = H @ P @ H.swapaxes(1, 2) + self.model.measurement_noise(t, channels)
        K, nu = P @ H.swapaxes(1, 2) @ np.linalg.inv(S), y - h
        white = np.linalg.solve(np.linalg.cholesky(S), nu[..., None])[..., 0]
        innovation = SimpleNamespace(white=white, nis=(white**2).sum(axis=1), dof=nu.shape[1])
        return (x + (K @ nu[..., None])[..., 0], P - K @ H @ P), innovation

    def mean(self, belief):
        return belief[0]

    def cov(self, belief):
        return belief[1]


def test_a_user_estimator_without_base_class_equals_the_ekf():
    results = estbench.run("cartpole", ["ekf", f"{__name__}:Plain"], runs=8, duration=0.3)
    np.testing.assert_allclose(
        results.records["Plain"]["anees"], results.records["ekf"]["anees"], rtol=1e-6
    )
    np.testing.assert_allclose(results["Plain"].anis.value, results["ekf"].anis.value, rtol=1e-6)


class Keyed(EKF):
    """Records the keys it is given."""

    def init(self, mean, cov, keys=None):
        object.__setattr__(self, "keys", keys)
        return super().init(mean, cov)


def test_keys_go_to_the_estimators_that_take_them():
    prepared, trajectory = recorded()
    keys = streams.run_keys(0, range(RUNS), "estimator:x")
    keyed = Keyed(prepared.model())
    run(keyed, prepared, trajectory, keys=keys)
    np.testing.assert_array_equal(keyed.keys, keys)
    run(EKF(prepared.model()), prepared, trajectory, keys=keys)  # and the others do not mind


@pytest.mark.parametrize(
    ("mean", "cov"),
    [
        (lambda m: m[:, :3], lambda P: P),
        (lambda m: m[0], lambda P: P),
        (lambda m: m, lambda P: P[0]),
        (lambda m: m, lambda P: np.diagonal(P, axis1=1, axis2=2)),
    ],
)
def test_an_estimator_of_the_wrong_shape(mean, cov):
    class Crooked(Plain):
        def mean(self, belief):
            return mean(belief[0])

        def cov(self, belief):
            return cov(belief[1])

    message = r"Crooked: mean has shape \(.*\) and cov \(.*\); expected \(6, 4\) and \(6, 4, 4\)"
    with pytest.raises(DimensionError, match=message):
        run(Crooked(recorded()[0].model()), *recorded())


class Raises(Plain):
    def update(self, *arguments, **options):
        raise ZeroDivisionError("gain")


def test_an_estimator_that_raises_is_named():
    with pytest.raises(EstimatorError, match=r"Raises raised ZeroDivisionError: gain"):
        estbench.run("cartpole", [f"{__name__}:Raises"], runs=2, duration=0.1)


def test_an_update_without_an_innovation():
    class Bare(EKF):
        def update(self, *arguments, **options):
            return super().update(*arguments, **options)[0]

    class Pair(Plain):
        def update(self, *arguments, **options):
            return super().update(*arguments, **options)[0]

    for one, kinds in ((Bare, "Gaussian"), (Pair, "ndarray, ndarray")):
        message = f"{one.__name__}: update returned {kinds}; return a pair, the belief and an Inno"
        with pytest.raises(EstimatorError, match=message):
            run(one(recorded()[0].model()), *recorded())


@pytest.mark.parametrize(
    ("field", "value", "found", "expected"),
    [
        ("nis", 0.0, r"\(\)", r"\(6,\)"),
        ("dof", np.ones((6, 1), int), r"\(6, 1\)", r"\(6,\)"),
        ("white", np.ones((6, 3)), r"\(6, 3\)", r"\(6, 2\)"),
        ("residual", np.ones(6), r"\(6,\)", r"\(6, 2\)"),
        ("cov", np.eye(3), r"\(3, 3\)", r"\(6, 2, 2\)"),
    ],
)
@pytest.mark.parametrize("started", [False, True])
def test_an_innovation_of_the_wrong_shape(field, value, found, expected, started):
    class Malformed(EKF):
        def update(self, *arguments, **options):
            belief, innovation = super().update(*arguments, **options)
            return belief, replace(innovation, **{field: value})

    prepared, trajectory = recorded()
    estimator = Malformed(prepared.model())
    if started:  # the readings that a start gathers are no check of the updates that follow
        estimator = WarmStart(estimator, prepared.model(), 0.1, "batch")
    message = (
        f"^Malformed: update returned an Innovation whose {field} has shape {found}; "
        f"expected {expected}"
    )
    with pytest.raises(DimensionError, match=message):
        run(estimator, prepared, trajectory)


def test_an_innovation_may_have_no_residual():
    class Silent(EKF):
        def update(self, *arguments, **options):
            belief, innovation = super().update(*arguments, **options)
            nothing = np.empty((len(innovation.nis), 0))
            return belief, replace(innovation, residual=nothing, cov=nothing, white=nothing)

    traces = run(Silent(recorded()[0].model()), *recorded(), keep_innovations=True)
    assert traces.lag_terms.sum() == 0
    assert np.isfinite(traces.nis).all()


# Runs that fail


class Sabotage(GaussianEstimator):
    """An EKF to which something is done after its update number `step`."""

    def __init__(self, model, step, harm):
        self.ekf, self.step, self.harm, self.count = EKF(model), step, harm, 0

    def predict(self, belief, u, t, dt):
        return self.ekf.predict(belief, u, t, dt)

    def update(self, belief, *arguments, **options):
        belief, innovation = self.ekf.update(belief, *arguments, **options)
        self.count += 1
        if self.count == self.step:
            self.harm(belief)
        return belief, innovation


def mark(belief, fault):
    belief.fault[2] = fault
    belief.mean[2], belief.cov[2] = np.nan, np.nan


@pytest.mark.parametrize(
    ("harm", "fault"),
    [
        (lambda b: b.mean.__setitem__(2, np.nan), Fault.STATE),
        (lambda b: b.mean.__setitem__((2, 1), np.inf), Fault.STATE),
        (lambda b: b.cov.__setitem__(2, -b.cov[2]), Fault.COVARIANCE),
        (lambda b: mark(b, Fault.INNOVATION), Fault.INNOVATION),
        (lambda b: mark(b, Fault.COVARIANCE), Fault.COVARIANCE),
    ],
)
def test_a_failing_run_is_marked_with_its_step_and_fault(harm, fault):
    prepared, trajectory = recorded()
    traces = run(Sabotage(prepared.model(), 7, harm), prepared, trajectory)
    healthy = run(EKF(prepared.model()), prepared, trajectory)
    expected = np.where(np.arange(RUNS) == 2, fault, Fault.NONE)
    np.testing.assert_array_equal(traces.fault, expected)
    np.testing.assert_array_equal(traces.fault_step, np.where(expected > 0, 7, -1))
    others = expected == 0
    np.testing.assert_array_equal(traces.nees[:, others], healthy.nees[:, others])
    np.testing.assert_array_equal(traces.nees[:7], healthy.nees[:7])
    assert np.isnan(traces.nees[7, 2])


def test_a_prior_that_is_not_positive_definite_fails_at_step_zero():
    prepared, trajectory = recorded()
    mean, cov = prior(prepared)
    cov[3] *= -1
    source = Recorded(prepared.instants, trajectory)
    with engine():
        traces = run_filter(
            EKF(prepared.model()), prepared.space, (mean, cov), source, prepared.channel_spaces
        )
    assert (traces.fault[3], traces.fault_step[3]) == (Fault.COVARIANCE, 0)
    assert traces.fault.sum() == Fault.COVARIANCE


@pytest.mark.parametrize("estimator", [EKF, Plain])
def test_a_truth_that_fails_is_not_the_estimators_fault(estimator):
    prepared, trajectory = recorded()
    traces = run(estimator(prepared.model()), prepared, shaken(trajectory, run=4, step=9))
    np.testing.assert_array_equal(traces.fault, [0, 0, 0, 0, Fault.TRUTH, 0])
    np.testing.assert_array_equal(traces.fault_step, [-1, -1, -1, -1, 9, -1])
    np.testing.assert_array_equal(np.isnan(traces.nees).any(axis=0), np.arange(RUNS) == 4)
