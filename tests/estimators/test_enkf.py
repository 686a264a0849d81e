import numpy as np
import pytest

from estbench.errors import DimensionError, EstimatorError
from estbench.estimators.beliefs import Fault
from estbench.estimators.ekf import EKF
from estbench.estimators.enkf import MEASUREMENT, EnKF
from estbench.randomness import counter as random
from tests.helpers import linear_model, mujoco_model, nonlinear_model, random_cov, random_states

FORMS = ("stochastic", "deterministic")


def start(model, runs, seed=0):
    rng = np.random.default_rng(seed)
    n = model.space.n
    cov = np.stack([random_cov(rng, n, scale=0.2) for _ in range(runs)])
    return rng.standard_normal((runs, n)), cov, rng.standard_normal((runs, model.nu))


def textbook(form, points, model, y, u, noise):
    """One run: ensemble `(size, n)` to posterior ensemble, equations of Evensen and Whitaker."""
    size = len(points)
    images = model.measurement(points[None], u[None], 0.0)[0]
    X, Y = points - points.mean(0), images - images.mean(0)
    R = model.measurement_noise(0.0)
    S = Y.T @ Y / (size - 1) + R
    K = X.T @ Y / (size - 1) @ np.linalg.inv(S)
    if form == "stochastic":
        noise = (noise - noise.mean(0)) * np.sqrt(size / (size - 1))
        return points + np.array([K @ (y + v - h) for v, h in zip(noise, images)])
    A, B = np.linalg.cholesky(S), np.linalg.cholesky(R)
    reduced = X.T @ Y / (size - 1) @ np.linalg.inv(A).T @ np.linalg.inv(A + B)
    mean = points.mean(0) + K @ (y - images.mean(0))
    return np.array([mean + (np.eye(len(mean)) @ e - reduced @ h) for e, h in zip(X, Y)])


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("n", [2, 4, 6])
def test_update_equals_the_textbook(form, n, seed):
    model = nonlinear_model(n)
    mean, cov, u = start(model, 3, seed)
    filter = EnKF(model, form, size=12)
    belief = filter.predict(filter.init(mean, cov), u, 0.0, 0.05)
    y = model.measurement(mean, u, 0.0) + 0.1
    R = model.measurement_noise(0.0)
    noise = random.gaussian(belief.keys, belief.counter, MEASUREMENT, R, 12)
    posterior, _ = filter.update(belief, y, u, 0.0)
    for i in range(3):
        expected = textbook(form, belief.points[i], model, y[i], u[i], noise[i])
        np.testing.assert_allclose(posterior.points[i], expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("form", FORMS)
def test_linear_mean_is_the_kalman_update_of_the_sample_moments(form):
    model = linear_model(1)
    mean, cov, u = start(model, 4)
    filter, kf = EnKF(model, form, size=9), EKF(model)
    belief = filter.predict(filter.init(mean, cov), u, 0.0, 1.0)
    y = model.measurement(mean, u) + 0.3
    posterior, innovation = filter.update(belief, y, u, 1.0)
    expected, reference = kf.update(kf.init(filter.mean(belief), filter.cov(belief)), y, u, 1.0)
    np.testing.assert_allclose(filter.mean(posterior), expected.mean, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(innovation.nis, reference.nis, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(innovation.cov, reference.cov, rtol=1e-10, atol=1e-10)
    if form == "deterministic":
        np.testing.assert_allclose(filter.cov(posterior), expected.cov, rtol=1e-10, atol=1e-10)


def deviation_from_kf(form, size, runs=150, steps=6):
    """Mean square of L⁻¹(x̂ - x̂_KF) and of the relative error of P over runs, after some steps."""
    model = linear_model(2)
    mean, cov, u = start(model, 1)
    mean, cov, u = (np.repeat(a, runs, axis=0) for a in (mean, cov, u))
    filter, kf = EnKF(model, form, size), EKF(model)
    a, b = filter.init(mean, cov), kf.init(mean, cov)
    for k in range(steps):
        a, b = filter.predict(a, u, k, 1.0), kf.predict(b, u, k, 1.0)
        y = model.measurement(b.mean, u) + 0.5
        a, b = filter.update(a, y, u, k)[0], kf.update(b, y, u, k)[0]
    white = np.linalg.inv(np.linalg.cholesky(b.cov))
    error = np.einsum("rij,rj->ri", white, filter.mean(a) - b.mean)
    shape = white @ filter.cov(a) @ np.swapaxes(white, -1, -2) - np.eye(3)
    return (error**2).sum(-1), (shape**2).sum((-1, -2))


@pytest.mark.parametrize("form", FORMS)
def test_error_against_kf_falls_as_one_over_root_of_size(form):
    small, large = deviation_from_kf(form, 60), deviation_from_kf(form, 960)
    for few, many in zip(small, large):
        # Mean squares over runs are asymptotically normal: 4 standard errors about the ratio 16,
        # and 10 % for the terms of order 1/size² at size 60.
        errors = [a.std() / a.mean() / np.sqrt(len(a)) for a in (few, many)]
        margin = 4 * np.hypot(*errors) + 0.1
        assert abs(np.log(few.mean() / many.mean() / 16)) < margin


@pytest.mark.parametrize("form", FORMS)
def test_missing_component_is_out_exactly(form):
    model = linear_model(3)
    mean, cov, u = start(model, 3)
    filter = EnKF(model, form, size=10)
    belief = filter.init(mean, cov)
    y = model.measurement(mean, u) + 0.2
    mask = np.array([[True, False], [False, False], [True, True]])
    absent = np.where(mask, y, np.nan)
    posterior, innovation = filter.update(belief, absent, u, 0.0, mask=mask)
    other, _ = filter.update(belief, np.where(mask, y, 1e6), u, 0.0, mask=mask)
    np.testing.assert_array_equal(posterior.points, other.points)
    np.testing.assert_array_equal(posterior.points[1], belief.points[1])
    np.testing.assert_array_equal(posterior.counter, [1, 0, 1])
    np.testing.assert_array_equal(innovation.dof, [1, 0, 2])
    full, _ = filter.update(belief, y, u, 0.0)
    np.testing.assert_array_equal(posterior.points[2], full.points[2])
    assert model.D is not None
    first = type(model)(model.A, model.C[:1], model.Q, model.R[:1, :1], model.B, model.D[:1])
    kf = EKF(first)
    expected, _ = kf.update(kf.init(filter.mean(belief), filter.cov(belief)), y[:, :1], u, 0.0)
    np.testing.assert_allclose(filter.mean(posterior)[0], expected.mean[0], rtol=1e-10, atol=1e-10)
    if form == "deterministic":
        np.testing.assert_allclose(
            filter.cov(posterior)[0], expected.cov[0], rtol=1e-10, atol=1e-10
        )


@pytest.mark.parametrize("form", FORMS)
def test_runs_do_not_depend_on_the_batch(form):
    model = linear_model(4)
    mean, cov, u = start(model, 6)
    keys = np.arange(100, 106, dtype=np.uint64)
    filter = EnKF(model, form, size=8, inflation=1.02)

    def run(rows):
        belief = filter.predict(filter.init(mean[rows], cov[rows], keys[rows]), u[rows], 0, 1)
        return filter.update(belief, np.ones((len(belief.points), 2)), u[rows], 1.0)[0].points

    whole = run(slice(0, 6))
    np.testing.assert_array_equal(whole[2:4], run(slice(2, 4)))
    assert np.abs(whole[0] - whole[1]).max() > 0.01


@pytest.mark.parametrize("form", FORMS)
def test_a_failed_run_stands_alone(form):
    model = linear_model(5)
    mean, cov, u = start(model, 4)
    mean[1], cov[2, 0, 0] = np.nan, -5.0
    filter = EnKF(model, form, size=8)
    belief = filter.predict(filter.init(mean, cov), u, 0.0, 1.0)
    belief, _ = filter.update(belief, np.ones((4, 2)), u, 1.0)
    np.testing.assert_array_equal(belief.fault, [0, Fault.STATE, Fault.COVARIANCE, 0])
    assert np.isnan(filter.mean(belief)[1:3]).all()
    assert np.isnan(filter.cov(belief)[1:3]).all()
    assert np.isfinite(filter.cov(belief)[[0, 3]]).all()


def test_inflation_scales_the_covariance():
    model = linear_model(6)
    mean, cov, u = start(model, 2)
    plain, inflated = EnKF(model, size=10), EnKF(model, size=10, inflation=1.1)
    a = plain.predict(plain.init(mean, cov), u, 0.0, 1.0)
    b = inflated.predict(inflated.init(mean, cov), u, 0.0, 1.0)
    np.testing.assert_allclose(inflated.cov(b), 1.1**2 * plain.cov(a), rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(inflated.mean(b), plain.mean(a), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("form", FORMS)
def test_quaternion_states_and_measurements(form):
    model = mujoco_model("joints", density=1e-4)
    x, u = random_states(model.mjmodel, 3)
    filter = EnKF(model, form, size=60, inflation=1.01)
    cov = np.broadcast_to(1e-4 * np.eye(model.space.n), (3, model.space.n, model.space.n))
    belief = filter.init(x, cov)
    for k in range(5):
        belief = filter.predict(belief, u, 0.004 * k, 0.004)
        truth = model.transition(x, u, 0.0, 0.004 * (k + 1))
        y = -model.measurement(truth, u, 0.0)  # -q is the same rotation; the lift is 1e-2 anyway
        y[:, :1] *= -1
        y[:, 9:] *= -1
        belief, innovation = filter.update(belief, y, u, 0.0)
    assert not belief.fault.any()
    assert (innovation.nis < 1.0).all()
    assert np.abs(model.space.minus(filter.mean(belief), truth)).max() < 0.05


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"form": "square"}, "EnKF: form is 'square'; use one of stochastic, deterministic"),
        ({"size": 1}, "EnKF: size is 1; use an integer of at least 2"),
        ({"size": 10.5}, "EnKF: size is 10.5"),
        ({"inflation": 0.9}, "EnKF: inflation is 0.9"),
    ],
)
def test_wrong_settings_say_so(settings, words):
    with pytest.raises(EstimatorError, match=words):
        EnKF(linear_model(0), **settings)


def test_wrong_shapes_say_so():
    with pytest.raises(DimensionError, match="mean has shape"):
        EnKF(linear_model(0)).init(np.zeros(3), np.eye(3))
    with pytest.raises(DimensionError, match="keys has shape"):
        EnKF(linear_model(0)).init(np.zeros((2, 3)), np.zeros((2, 3, 3)), np.zeros(1, np.uint64))
