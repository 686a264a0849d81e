"""Through given measurements an estimator goes the way the event loop takes it."""

import numpy as np
import pytest

from estbench.errors import CovarianceError, DimensionError, EstimatorError, ModelError
from estbench.estimators import registry
from estbench.estimators.ekf import EKF
from estbench.following import follow
from estbench.inference.event_loop import run_filter
from estbench.models.linear import LinearModel
from estbench.sensors.delivery import Delivery
from estbench.sensors.timing import Instant
from estbench.simulation.sources import Recorded, Trajectory
from estbench.smoothers.rts import rts
from tests.helpers import nonlinear_model, random_cov

RUNS, STEPS = 5, 12
TIMES = np.array([0.0, 0.1, 0.15, *np.arange(2, STEPS) * 0.1 + 0.05])


def given(seed=0):
    """A model, prior, controls, and what was measured."""
    rng = np.random.default_rng(seed)
    model = nonlinear_model()
    mean, cov = 0.3 * rng.standard_normal((RUNS, 2)), random_cov(rng, 2, RUNS, 0.05)
    u = rng.standard_normal((STEPS, RUNS, 1))
    reference = model.measurement(mean, u[0])
    y = reference + 0.05 * rng.standard_normal((STEPS, RUNS, reference.shape[-1]))
    return model, mean, cov, u, y


@pytest.mark.parametrize("name", ["ekf", "ukf", "sr_ekf", "pf", "rts", "urts", "map"])
def test_the_beliefs_are_those_of_the_event_loop(name):
    model, mean, cov, u, y = given()
    missing = np.zeros((STEPS, RUNS), bool)
    missing[3], missing[5, 1], missing[-1, [0, 4]] = True, True, True
    y[missing] = np.nan
    keys = np.arange(7, 7 + RUNS, dtype=np.uint64)
    instants = [
        Instant(*TIMES[k : k + 2].tolist(), 1, ("radar",), True, k + 1) for k in range(STEPS)
    ]
    readings = [
        [] if missing[k].all() else [Delivery(("radar",), k + 1, y[k], ~missing[k], k + 1)]
        for k in range(STEPS)
    ]
    source = Recorded(instants, Trajectory(np.zeros((STEPS + 1, RUNS, 2)), u, readings))
    expected = run_filter(
        registry.create(name, {}, model), model.space, (mean, cov), source,
        {"radar": model.output()}, keys=keys, keep_cov=True,
    )  # fmt: skip
    assert expected is not None
    assert expected.cov is not None
    estimator = registry.create(name, {}, model)
    history = follow(estimator, mean, cov, y, u=u, times=TIMES, keys=keys)
    beliefs = estimator.smooth(history) if hasattr(estimator, "smooth") else history.beliefs
    for k, belief in enumerate(beliefs):
        np.testing.assert_allclose(estimator.mean(belief), expected.mean[k], rtol=0, atol=1e-12)
        np.testing.assert_allclose(estimator.cov(belief), expected.cov[k], rtol=0, atol=1e-12)


def test_one_component_may_be_missing_and_time_is_counted_in_steps():
    model, mean, cov, _, y = given(1)
    y[:, :, 0] = np.nan
    ekf = registry.create("ekf", {}, model)
    history = follow(ekf, mean, cov, y)
    belief, still = ekf.init(mean, cov), np.zeros((RUNS, 1))
    mask = np.broadcast_to([False] + [True] * (y.shape[-1] - 1), y[0].shape)
    for k in range(STEPS):
        belief = ekf.predict(belief, still, float(k), 1.0)
        belief, _ = ekf.update(belief, np.nan_to_num(y[k]), still, k + 1.0, None, mask)
        np.testing.assert_allclose(history.beliefs[k + 1].mean, belief.mean, rtol=0, atol=1e-12)
        np.testing.assert_allclose(history.beliefs[k + 1].cov, belief.cov, rtol=0, atol=1e-12)
    smoothed = rts(model, history.beliefs, history.controls, history.times)
    assert np.isfinite([b.mean for b in smoothed]).all()


@pytest.mark.parametrize("given_u", [False, True])
def test_an_estimator_that_shows_no_model_is_given_what_was_measured(given_u):
    model, mean, cov, u, y = given(2)
    ekf, still = registry.create("ekf", {}, model), np.zeros((RUNS, 1))
    seen = []

    class Own:
        def __init__(self):
            self.init, self.mean, self.cov = ekf.init, ekf.mean, ekf.cov

        def predict(self, belief, held, t, dt):
            seen.append(held.shape)
            return ekf.predict(belief, held if given_u else still, t, dt)

        def update(self, belief, measured, held, *more):
            seen.append(held.shape)
            return ekf.update(belief, measured, held if given_u else still, *more)

    found = follow(Own(), mean, cov, y, u=u if given_u else None)
    assert set(seen) == {(RUNS, 1 if given_u else 0)}
    expected = follow(ekf, mean, cov, y, u=u if given_u else None)
    np.testing.assert_array_equal(found.beliefs[-1].mean, expected.beliefs[-1].mean)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"y": np.zeros((STEPS, 2))}, r"y has shape \(12, 2\); expected \(step, 5, 2\)"),
        ({"y": np.zeros((STEPS, RUNS, 3))}, r"y has shape \(12, 5, 3\); expected \(step, 5, 2\)"),
        ({"u": np.zeros((STEPS - 1, RUNS, 1))}, r"u has shape \(11, 5, 1\); expected \(12, 5, 1\)"),
        ({"u": [[1, 2], [3]]}, r"u is list of object; expected float64 numbers, \(step, run, nu\)"),
        (
            {"times": np.arange(STEPS)},
            r"u has shape \(12, 5, 1\); expected \(11, 5, 1\), one",
        ),
        ({"times": np.arange(STEPS + 3)}, r"times has shape \(15,\); expected 13 rising numbers"),
        ({"times": [0.0, 0.2, 0.1, *range(3, STEPS + 1)]}, r"times\[1\] is 0.2 and the next 0.1; "),
        ({"times": [0.0, np.nan, *range(2, STEPS + 1)]}, r"times\[0\] is 0 and the next nan; give"),
    ],
)
def test_what_does_not_fit_is_named(changes, message):
    model, mean, cov, u, y = given()
    arguments = {"y": y, "u": u} | changes
    with pytest.raises(DimensionError, match=message):
        follow(registry.create("ekf", {}, model), mean, cov, arguments.pop("y"), **arguments)


A, C, NOISE, R = (
    np.array([[1.0, 0.5], [0.0, 1.0]]),
    np.array([[1.0, 0.0]]),
    0.1 * np.eye(2),
    np.eye(1),
)
LINEAR = LinearModel(A=A, C=C, Q=NOISE, R=R)
MEAN, COV = np.array([[0.0, 1.0], [1.0, -1.0]]), np.tile(np.eye(2), (2, 1, 1))


def textbook(readings):
    """Kalman filter of run 0; a list of readings for each time, the first for the start."""
    x, P, nis = MEAN[0], COV[0], []
    for k, at_once in enumerate(readings):
        if k:
            x, P = A @ x, A @ P @ A.T + NOISE
        for y in at_once:
            S = C @ P @ C.T + R
            K, v = P @ C.T / S, y - C @ x
            nis.append(float(v @ v / S[0, 0]))
            x, P = x + K @ v, P - K @ C @ P
    return x, P, nis


def measured(count, seed=0):
    return np.random.default_rng(seed).standard_normal((count, 2, 1))


def test_a_reading_at_the_start_and_two_at_one_time():
    y = measured(5)
    times = [3.0, 4.0, 4.0, 5.0, 6.0]
    for name in ("kf", "ekf", "ukf"):
        estimator = registry.create(name, {}, LINEAR)
        history = follow(estimator, MEAN, COV, y, times=times)
        x, P, nis = textbook([[y[0, 0]], [y[1, 0], y[2, 0]], [y[3, 0]], [y[4, 0]]])
        np.testing.assert_allclose(estimator.mean(history.beliefs[-1])[0], x, atol=1e-10)
        np.testing.assert_allclose(estimator.cov(history.beliefs[-1])[0], P, atol=1e-10)
        expected = [nis[0], nis[1] + nis[2], nis[3], nis[4]]
        np.testing.assert_allclose(history.nis[:, 0], expected, rtol=1e-9)
        assert history.times == [3.0, 4.0, 5.0, 6.0]
        np.testing.assert_array_equal(history.index, [0, 1, 1, 2, 3])
        np.testing.assert_array_equal(history.dof[:, 0], [1, 2, 1, 1])
        assert len(history.beliefs) == 4


@pytest.mark.parametrize("name", ["rts", "map"])
def test_smoothers_take_equal_times_and_a_reading_at_the_start(name):
    y = measured(5)
    smoother = registry.create(name, {}, LINEAR)
    history = follow(smoother, MEAN, COV, y, times=[0.0, 1.0, 1.0, 2.0, 3.0])
    smoothed = smoother.smooth(history)
    # The batch least-squares solution: four states in one vector.
    states = [np.linalg.matrix_power(A, k) for k in range(4)]
    mean = np.concatenate([F @ MEAN[0] for F in states])
    D = np.zeros((8, 8))
    for k in range(4):
        for j in range(k + 1):
            D[2 * k : 2 * k + 2, 2 * j : 2 * j + 2] = states[k - j]
    prior = D @ np.diag([1.0, 1.0, *[0.1] * 6]) @ D.T
    H = np.zeros((5, 8))
    H[range(5), [0, 2, 2, 4, 6]] = 1.0
    gain = prior @ H.T @ np.linalg.inv(H @ prior @ H.T + np.eye(5))
    expected = mean + gain @ (y[:, 0, 0] - H @ mean)
    found = np.concatenate([smoother.mean(belief)[0] for belief in smoothed])
    np.testing.assert_allclose(found, expected, atol=1e-7)


def test_what_is_kept():
    y = measured(400)
    y[7] = np.nan
    ekf = registry.create("ekf", {}, LINEAR)
    history, moments, last = (
        follow(ekf, MEAN, COV, y, keep=keep) for keep in ("beliefs", "moments", "last")
    )
    assert moments.mean is not None
    assert moments.cov is not None
    np.testing.assert_array_equal(moments.mean, [b.mean for b in history.beliefs])
    np.testing.assert_array_equal(moments.cov, [b.cov for b in history.beliefs])
    for short in (moments, last):
        assert len(short.beliefs) == 1
        assert not short.measurements
        np.testing.assert_array_equal(short.beliefs[0].mean, history.beliefs[-1].mean)
        np.testing.assert_array_equal(short.nis, history.nis)
    assert np.isnan(history.nis[[0, 8]]).all()
    assert np.isfinite(np.delete(history.nis, [0, 8], axis=0)).all()
    assert history.innovation is not None
    np.testing.assert_allclose(
        history.innovation[1:, :, 0] ** 2 / history.innovation_cov[1:, :, 0, 0], history.nis[1:]
    )
    assert last.innovation is None
    white = history.whiteness()
    assert white is not None
    assert len(white.correlation) == 10
    with pytest.raises(EstimatorError, match="keep is 'all'; use 'beliefs', 'moments' or 'last'"):
        follow(ekf, MEAN, COV, y, keep="all")


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (lambda m, P: (m, -0.5 * P), CovarianceError, "of run 0 is not .* eigenvalue is -0.5"),
        (
            lambda m, P: (m, np.add(P, [[0, 1], [0, 0]])),
            CovarianceError,
            r"entry \[0, 1\] is 1 and",
        ),
        (lambda m, P: (m, np.nan * P), CovarianceError, r"entry \[0, 0\] is nan"),
        (lambda m, P: (m, P + 0j), DimensionError, "cov is ndarray of complex128"),
        (lambda m, P: (m, np.ma.masked_less(P, 0)), DimensionError, "cov is a masked array"),
        (lambda m, P: (np.ma.masked_equal(m, 0), P), DimensionError, "mean is a masked array"),
        (lambda m, P: (m + np.nan, P), DimensionError, "mean is nan in run 0, coordinate 0"),
        (lambda m, P: (m[0], P), DimensionError, r"mean has shape \(2,\) and cov"),
        (lambda m, P: (m, P[0]), DimensionError, r"cov \(2, 2\); expected"),
    ],
)
def test_a_prior_that_is_none(change, error, message):
    mean, cov = change(MEAN, COV)
    with pytest.raises(error, match=message) as caught:
        follow(registry.create("ekf", {}, LINEAR), mean, cov, measured(3))
    assert len(str(caught.value).splitlines()) == 1


def test_a_linear_model_with_uneven_steps():
    kf = registry.create("kf", {}, LINEAR)
    with pytest.raises(ModelError, match=r"steps of 0.1 s and of 0.3 s, but LinearModel ignores"):
        follow(kf, MEAN, COV, measured(2), times=[0.0, 0.1, 0.4])
    follow(kf, MEAN, COV, measured(3), times=[0.0, 0.1, 0.1, 0.1 + 0.1])
    still = LinearModel(A=np.eye(2), C=C, Q=np.zeros((2, 2)), R=R)  # nothing to scale
    follow(registry.create("kf", {}, still), MEAN, COV, measured(2), times=[0.0, 0.1, 0.4])


def test_an_estimator_that_raises_is_named_with_its_line():
    class Late(EKF):
        def predict(self, belief, u, t, dt):
            if t > 3:
                raise KeyError("gain")
            return super().predict(belief, u, t, dt)

    with pytest.raises(EstimatorError, match=r"Late raised KeyError: 'gain' \(test_following.py"):
        follow(Late(LINEAR), MEAN, COV, measured(6))
