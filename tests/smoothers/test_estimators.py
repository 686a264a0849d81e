"""Smoothers as estimators: in one table with the filters, and equal to the functions they call."""

import numpy as np
import pytest

from estbench.errors import EstimatorError
from estbench.estimators import registry
from estbench.estimators.beliefs import Fault, Gaussian
from estbench.estimators.ekf import EKF
from estbench.estimators.protocol import FilterHistory, Measurement, Smoother
from estbench.estimators.ukf import PREDICTION, SigmaPointFilter
from estbench.experiment import setup
from estbench.inference.event_loop import run_filter
from estbench.inference.fusion import Delays
from estbench.montecarlo import run as experiment
from estbench.robots.library import engine
from estbench.sensors.delivery import divided
from estbench.simulation.sources import Recorded
from estbench.smoothers.estimators import MAP, RTS, URTS
from estbench.smoothers.map import map_estimate
from estbench.smoothers.rts import rts
from tests.estimators.test_enkf import start as prior
from tests.helpers import linear_model, nonlinear_model, random_cov, simulated

RUNS = 4


def filter_history(estimator, seed=0, steps=6, runs=3):
    """A filter's way through random measurements of a linear model."""
    rng = np.random.default_rng(seed)
    mean, cov = rng.standard_normal((runs, 3)), random_cov(rng, 3, runs)
    belief = estimator.init(mean, cov)
    beliefs, controls, measurements = [belief], [], [[]]
    for k in range(steps):
        u, y = rng.standard_normal((runs, 1)), rng.standard_normal((runs, 2))
        mask = rng.random((runs, 2)) > 0.2
        belief = estimator.predict(belief, u, float(k), 1.0)
        belief, _ = estimator.update(belief, y, u, k + 1.0, None, mask)
        beliefs.append(belief)
        controls.append(u)
        measurements.append([Measurement(y, u, None, mask)])
    return FilterHistory(beliefs, controls, [float(k) for k in range(steps + 1)], measurements)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("name", "settings"),
    [("rts", {"base": base}) for base in ("ekf", "iekf", "sr_ekf", "kf", "lkf")]
    + [("urts", {"base": base}) for base in ("ukf", "sr_ukf", "ckf", "ghkf", "rotated_ukf", "iplf")]
    + [("ipls", {"base": base}) for base in ("iplf", "ukf", "ckf", "ghkf", "rotated_ukf")]
    + [("map", {}), ("map", {"base": "ukf", "window": 6.0})],
)
def test_all_are_one_on_a_linear_model(name, settings, seed):
    model = linear_model(seed)
    smoother = registry.create(name, settings, model)
    assert isinstance(smoother, Smoother)
    reference = filter_history(EKF(model), seed)
    expected = rts(model, reference.beliefs, reference.controls, reference.times)
    smoothed = smoother.smooth(filter_history(smoother, seed))
    assert len(smoothed) == len(expected) == 7
    for ours, other in zip(smoothed, expected):
        np.testing.assert_allclose(smoother.mean(ours), other.mean, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(smoother.cov(ours), other.cov, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(("window", "ends"), [(2.0, [2, 4, 6]), (4.0, [4, 6]), (0.5, [1, 2, 3])])
def test_a_window_starts_from_the_filter_and_knows_its_own_measurements(window, ends):
    model = linear_model(1)
    whole = filter_history(EKF(model))
    smoothed = MAP(model, window=window).smooth(whole)
    first = 0
    for last in ends:
        part = slice(first, last + 1)
        expected = rts(model, whole.beliefs[part], whole.controls[first:last], whole.times[part])
        # A time between two windows is the start of the later one.
        for k in range(first, last if last < 6 else last + 1):
            np.testing.assert_allclose(
                smoothed[k].mean, expected[k - first].mean, rtol=1e-10, atol=1e-10
            )
            np.testing.assert_allclose(
                smoothed[k].cov, expected[k - first].cov, rtol=1e-10, atol=1e-10
            )
        first = last


def recorded(robot="pendulum", *overrides, duration=0.3):
    prepared = setup.build(experiment.resolve(robot, duration=duration, overrides=overrides))
    return prepared, Recorded(prepared.instants, simulated(prepared, RUNS))


def traced(estimator, prepared, source, delays=None):
    prior = tuple(np.repeat(a[None], RUNS, axis=0) for a in (prepared.mean, prepared.cov))
    with engine():
        traces = run_filter(
            estimator, prepared.space, prior, source, prepared.channel_spaces,
            keep_cov=True, delays=delays,
        )  # fmt: skip
    assert traces is not None
    return traces


@pytest.mark.parametrize("robot", ["pendulum", "quadrotor"])
def test_what_is_judged_is_the_smoothed_run_and_the_filters_innovations(robot):
    prepared, source = recorded(robot, duration=0.1)
    filtered = traced(EKF(prepared.model()), prepared, source)
    smoothed = traced(RTS(prepared.model(), base="ekf"), prepared, source)
    np.testing.assert_array_equal(smoothed.nis, filtered.nis)
    np.testing.assert_array_equal(smoothed.dof, filtered.dof)
    np.testing.assert_array_equal(smoothed.truth, filtered.truth)
    posteriors = [
        Gaussian(m, P, np.zeros(RUNS, np.uint8)) for m, P in zip(filtered.mean, filtered.cov)
    ]
    controls = [source.control(k, np.empty(0)) for k in range(len(source.events))]
    with engine():
        expected = rts(prepared.model(), posteriors, controls, prepared.times.tolist())
    np.testing.assert_allclose(smoothed.mean, [b.mean for b in expected], rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(smoothed.cov, [b.cov for b in expected], rtol=1e-10, atol=1e-12)
    error = prepared.space.minus(smoothed.truth, smoothed.mean)
    np.testing.assert_array_equal(smoothed.error, error)
    assert (smoothed.std[:-1] <= filtered.std[:-1] * (1 + 1e-9)).all()
    assert smoothed.cpu_time > 0


class Witness(RTS):
    """Keeps what it was shown."""

    def smooth(self, history):
        object.__setattr__(self, "seen", history)
        return super().smooth(history)


@pytest.mark.parametrize("latency", [0.0, 0.05])
def test_a_late_reading_stands_where_it_belongs(latency):
    """The history is that of a filter that had each reading in its time."""
    prepared, source = recorded("pendulum", f"channels.encoder.latency={latency}")
    witness = Witness(prepared.model(), base="ekf")
    traced(witness, prepared, source, Delays(window=prepared.window))
    seen: FilterHistory = witness.seen  # type: ignore[attr-defined]
    ekf = EKF(prepared.model())
    belief = seen.beliefs[0]
    late = 0
    with engine():
        for k, u in enumerate(seen.controls):
            t, dt = seen.times[k], seen.times[k + 1] - seen.times[k]
            belief = ekf.predict(belief, u, t, dt)
            for m in seen.measurements[k + 1]:
                belief, _ = ekf.update(belief, m.y, m.u, t + dt, m.channels, m.mask)
                late += "encoder" in m.channels
            np.testing.assert_allclose(
                seen.beliefs[k + 1].mean, belief.mean, rtol=1e-10, atol=1e-12
            )
            np.testing.assert_allclose(seen.beliefs[k + 1].cov, belief.cov, rtol=1e-10, atol=1e-12)
    assert late == 30 - round(latency / 0.01)


@pytest.mark.parametrize("w0", [0.25, 0.0, -0.3])
def test_the_gain_after_a_rotated_filter_is_of_the_points_of_its_prediction(w0):
    """Särkkä (2013), eq. 9.20, with x̂⁻ and P⁻, in which Ω is counted twice, of the filter."""
    model = nonlinear_model(4)
    smoother = URTS(model, base="rotated_ukf", settings={"centre_weight": w0})
    filter = smoother._filter
    assert isinstance(filter, SigmaPointFilter)
    mean, cov, u = prior(model, 3)
    before = smoother.init(mean, cov, np.array([5, 6, 7], np.uint64))
    ahead = filter.predict(before, u, 0.0, 0.2)
    after, _ = filter.update(ahead, model.measurement(mean, u, 0.0) + 0.2, u, 0.2)
    found = smoother.smooth(FilterHistory([before, after], [u], [0.0, 0.2], [[], []]))[0]
    rule = filter.rule_at(before, PREDICTION)
    spread = rule.points @ np.linalg.cholesky(cov).mT
    images = model.transition(mean[:, None] + spread, u, 0.0, 0.2)
    for i in range(3):
        cross = sum(
            w * np.outer(d, image - ahead.mean[i])
            for w, d, image in zip(rule.cov_weights, spread[i], images[i])
        )
        G = cross @ np.linalg.inv(ahead.cov[i])
        x = mean[i] + G @ (after.mean[i] - ahead.mean[i])
        P = cov[i] + G @ (after.cov[i] - ahead.cov[i]) @ G.T
        np.testing.assert_allclose(found.mean[i], x, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(found.cov[i], P, rtol=1e-10, atol=1e-10)


def test_a_run_that_the_filter_lost_is_lost_at_all_times():
    prepared, source = recorded()

    class Breaking(EKF):
        def update(self, belief, y, u, t, channels=None, mask=None):
            posterior, innovation = super().update(belief, y, u, t, channels, mask)
            if t > 0.155:
                posterior.mean[1] = np.nan
            return posterior, innovation

    smoother = RTS(prepared.model())
    object.__setattr__(smoother, "_filter", Breaking(prepared.model()))
    traces = traced(smoother, prepared, source)
    np.testing.assert_array_equal(traces.fault > 0, [False, True, False, False])
    assert traces.fault[1] == Fault.STATE
    assert traces.fault_step[1] == 16
    assert np.isnan(traces.nees[:16, 1]).all()
    assert np.isfinite(traces.nees[:, [0, 2, 3]]).all()


def test_map_is_the_function_on_the_filters_means():
    prepared, source = recorded(duration=0.1)
    smoother = MAP(prepared.model(), iterations=1)
    traces = traced(smoother, prepared, source)
    filtered = traced(EKF(prepared.model()), prepared, source)
    prior = Gaussian(filtered.mean[0], filtered.cov[0], np.zeros(RUNS, np.uint8))
    controls = [source.control(k, np.empty(0)) for k in range(10)]
    measured: list[list[Measurement]] = [[]]
    for k in range(10):
        _, arrived = source.advance(k, controls[k])
        y = np.concatenate([d.y for d in divided(arrived)], axis=1)
        measured.append([Measurement(y, controls[k], [d.channels[0] for d in divided(arrived)])])
    with engine():
        expected = map_estimate(
            prepared.model(), prior, controls, prepared.times.tolist(), measured,
            start=list(filtered.mean), iterations=1,
        )  # fmt: skip
    np.testing.assert_allclose(
        traces.mean, [b.mean for b in expected.beliefs], rtol=1e-10, atol=1e-12
    )


def test_in_one_table_with_their_filters():
    results = experiment.run("acrobot", ["ekf", "rts", "urts", "map"], runs=20, duration=0.5)
    for name in ("rts", "urts", "map"):
        assert results[name].diverged == 0
        assert results[name].anees.low < 1.15
        assert results[name].anees.high > 0.85
        assert all(a.value < 0.9 * b.value for a, b in zip(results[name].rmse, results["ekf"].rmse))
    assert results["rts"].anis.value == pytest.approx(results["ekf"].anis.value, rel=1e-9)


@pytest.mark.parametrize(
    ("cls", "settings", "message"),
    [
        (RTS, {"base": "ukf"}, "RTS: base is 'ukf'; use one of ekf, iekf, sr_ekf, kf, lkf, cd_ekf"),
        (URTS, {"base": "ekf"}, "URTS: base is 'ekf'; use one of ukf"),
        (MAP, {"base": "bias_ekf"}, "MAP: base is 'bias_ekf'; use one of ekf"),
        (MAP, {"settings": {"covariance_updat": "joseph"}}, "no setting 'covariance_updat' .did"),
        (MAP, {"window": 0.0}, r"MAP: window is 0.0; use a number in \(0, inf\]"),
        (MAP, {"iterations": 0}, "MAP: iterations is 0; use an integer of at least 1"),
        (MAP, {"tolerance": 0.0}, "MAP: tolerance is 0.0"),
    ],
)
def test_bad_settings(cls, settings, message):
    with pytest.raises(EstimatorError, match=message):
        cls(linear_model(0), **settings)


def test_a_window_longer_than_the_run():
    longer = experiment.resolve("pendulum", ["map"], duration=0.3,
                                overrides=["estimators.map.window=0.4"])  # fmt: skip
    with pytest.raises(EstimatorError, match=r"map: window is 0.4 s but the run only 0.3 s; short"):
        setup.build(longer)


def test_a_users_filter_can_be_smoothed():
    smoother = RTS(linear_model(0), base="estbench.estimators.ekf:EKF")
    assert len(smoother.smooth(filter_history(smoother))) == 7


class Wrapped(EKF):
    """A filter of one's own, whose belief is a tuple: only the filter knows mean and covariance."""

    def init(self, mean, cov):
        return (super().init(mean, cov),)

    def predict(self, belief, u, t, dt):
        return (super().predict(belief[0], u, t, dt),)

    def update(self, belief, y, u, t, channels=None, mask=None):
        posterior, innovation = super().update(belief[0], y, u, t, channels, mask)
        return (posterior,), innovation

    def mean(self, belief):
        return belief[0].mean

    def cov(self, belief):
        return belief[0].cov


@pytest.mark.parametrize("kind", [RTS, MAP])
def test_a_base_of_ones_own_answers_for_its_beliefs(kind):
    own, built_in = (kind(linear_model(0), base=base) for base in (f"{__name__}:Wrapped", "ekf"))
    one, other = filter_history(own), filter_history(built_in)
    for estimator, history in ((own, one), (built_in, other)):
        np.testing.assert_array_equal(
            estimator.cov(history.beliefs[3]), built_in.cov(other.beliefs[3])
        )
    for a, b in zip(own.smooth(one), built_in.smooth(other)):
        np.testing.assert_array_equal(own.mean(a), built_in.mean(b))
        np.testing.assert_array_equal(own.cov(a), built_in.cov(b))
        assert not a.fault.any()
