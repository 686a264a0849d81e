import numpy as np
import pytest
from scipy.special import gammaln

import estbench
from estbench.errors import EstimatorError
from estbench.estimators.beliefs import start
from estbench.estimators.imm import IMM
from estbench.estimators.rotated_ukf import RotatedUKF
from estbench.estimators.ukf import MEASUREMENT, PREDICTION
from estbench.inference import run_subset
from estbench.models.function import FunctionModel
from estbench.randomness.orthogonal import haar
from tests.estimators.test_enkf import start as prior
from tests.helpers import mujoco_model, nonlinear_model, random_cov, random_states


def textbook_moments(function, mean, cov, axes, w0, omega):
    """Mean, covariance and cross-covariance of one run, with loops."""
    n = len(mean)
    lower, radius = np.linalg.cholesky(cov), np.sqrt(n / (1 - w0))
    unit = [sign * radius * axis for sign in (1, -1) for axes_ in axes for axis in axes_]
    weight = [(1 - w0) / len(unit)] * len(unit)
    unit, weight = [np.zeros(n), *unit], [w0, *weight]
    values = [function(mean + lower @ xi) for xi in unit]
    centre = sum(w * v for w, v in zip(weight, values))
    residuals = [v - centre for v in values]
    spread = sum(w * np.outer(r, r) for w, r in zip(weight, residuals))
    slope = sum(w * np.outer(r, xi) for w, r, xi in zip(weight, residuals, unit))
    return centre, spread + omega * (spread - slope @ slope.T), lower @ slope.T


@pytest.mark.parametrize("n", [2, 4, 6])
@pytest.mark.parametrize(("omega", "w0", "rotations"), [(1.0, 0.0, 1), (0.3, 0.25, 3)])
def test_equals_the_textbook(n, omega, w0, rotations):
    model = nonlinear_model(n)
    mean, cov, u = prior(model, 3)
    filter = RotatedUKF(model, omega=omega, centre_weight=w0, rotations=rotations)
    begun = filter.init(mean, cov, np.array([5, 6, 7], np.uint64))
    ahead = filter.predict(begun, u, 0.0, 0.05)
    y = model.measurement(mean, u, 0.0) + 0.1
    after, innovation = filter.update(ahead, y, u, 0.05)
    Q, R = model.process_noise(mean, u, 0.0, 0.05), model.measurement_noise(0.05)
    for i in range(3):
        axes = haar(begun.keys, begun.counter, PREDICTION, rotations, n)[i]

        def move(x, i=i):
            return model.transition(x[None], u[i : i + 1], 0.0, 0.05)[0]

        def see(x, i=i):
            return model.measurement(x[None], u[i : i + 1], 0.05)[0]

        x, P, _ = textbook_moments(move, mean[i], cov[i], axes, w0, omega)
        np.testing.assert_allclose(ahead.mean[i], x, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(ahead.cov[i], P + Q, rtol=1e-10, atol=1e-10)
        axes = haar(begun.keys, begun.counter + np.uint64(1), MEASUREMENT, rotations, n)[i]
        h, S, cross = textbook_moments(see, ahead.mean[i], ahead.cov[i], axes, w0, omega)
        S = S + R
        K = cross @ np.linalg.inv(S)
        np.testing.assert_allclose(innovation.cov[i], S, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(after.mean[i], ahead.mean[i] + K @ (y[i] - h), atol=1e-10)
        np.testing.assert_allclose(after.cov[i], ahead.cov[i] - K @ S @ K.T, atol=1e-10)


def test_rotations_average_to_the_moments_of_a_kinked_function():
    """|x₁| and the step x₁ > 0 of a normal x in n = 5, over 4000 runs with a rotation each.

    The mean over the rotations is √n E|u₁|, u uniform on the sphere; it differs from √(2/π) by the
    fixed radius only. The fixed rule has 1/√n and 1/2n in place of 0.839 and 1/2. Seeded; a fresh
    seed would fail with probability 1e-4.
    """
    n, runs = 5, 4000
    none = np.zeros((n, n)), np.eye(1)
    u, mean, cov = np.zeros((runs, 0)), np.zeros((runs, n)), np.tile(np.eye(n), (runs, 1, 1))
    sphere = np.sqrt(n / np.pi) * np.exp(gammaln(n / 2) - gammaln((n + 1) / 2))
    for function, exact, fixed, normal in (
        (np.abs, sphere, 1 / np.sqrt(n), np.sqrt(2 / np.pi)),
        (lambda x: (x > 0) * 1.0, 0.5, 1 / (2 * n), 0.5),
    ):
        model = FunctionModel(
            lambda x, u, t, dt, f=function: f(x), lambda x, u, t: x[..., :1], *none
        )
        filter = RotatedUKF(model, omega=0.0, centre_weight=0.0)
        ahead = filter.predict(filter.init(mean, cov), u, 0.0, 1.0)
        for i in range(n):
            error = ahead.mean[:, i].std() / np.sqrt(runs)
            assert abs(ahead.mean[:, i].mean() - exact) < 4.2 * error + 1e-12
        unrotated = function(filter.rule.points[:, 0]).mean()
        np.testing.assert_allclose(unrotated, fixed, atol=1e-12)
        assert abs(exact - normal) < 0.15 * abs(fixed - normal)


def test_the_error_of_the_regression_is_counted_omega_times():
    model = nonlinear_model(4)
    mean, cov, u = prior(model, 3)
    plain, once, twice = (
        filter.predict(filter.init(mean, cov), u, 0.0, 0.3).cov
        for filter in (RotatedUKF(model, omega=omega) for omega in (0.0, 1.0, 2.0))
    )
    np.testing.assert_allclose(twice - once, once - plain, atol=1e-12)
    assert (np.linalg.eigvalsh(once - plain) > -1e-14).all()
    assert (np.linalg.eigvalsh(once - plain)[:, -1] > 1e-5).all()


def test_points_that_are_not_redrawn():
    model = nonlinear_model(4)
    mean, cov, u = prior(model, 3)
    filter = RotatedUKF(model, redraw=False, centre_weight=0.0)
    ahead = filter.predict(filter.init(mean, cov), u, 0.0, 0.05)
    assert ahead.points.shape == (3, 8, 4)
    after, innovation = filter.update(ahead, model.measurement(mean, u, 0.0), u, 0.05)
    images = model.measurement(ahead.points, u, 0.05)
    spread = images - images.mean(axis=1, keepdims=True)
    S = spread.mT @ spread / 8 + model.measurement_noise(0.05)
    np.testing.assert_allclose(innovation.cov, S, rtol=1e-10, atol=1e-10)
    assert after.points is None


def followed(filter, rows, steps=3):
    """Some runs of a robot with a ball and a free joint."""
    model = mujoco_model("joints", "additive", 0.01)
    x, u = random_states(model.mjmodel, 4, seed=3)
    y = model.measurement(random_states(model.mjmodel, 4, seed=4)[0], u, 0.0)
    cov = 0.05 * random_cov(np.random.default_rng(3), model.space.n, 4)
    filter = filter(model)
    belief = start(filter, x[rows], cov[rows], np.arange(20, 24, dtype=np.uint64)[rows])
    means = []
    for k in range(steps):
        belief = filter.predict(belief, u[rows], 0.008 * k, 0.008)
        belief, _ = filter.update(belief, y[rows], u[rows], 0.008 * (k + 1))
        means.append(filter.mean(belief))
    return np.array(means), filter.cov(belief)


@pytest.mark.parametrize(
    "filter", [RotatedUKF, lambda model: IMM(model, base="rotated_ukf")], ids=["alone", "imm"]
)
def test_a_run_does_not_depend_on_the_batch(filter):
    whole, few = followed(filter, slice(0, 4)), followed(filter, slice(1, 3))
    np.testing.assert_array_equal(whole[0][:, 1:3], few[0])
    np.testing.assert_array_equal(whole[1][1:3], few[1])


def test_an_experiment_does_not_depend_on_the_batches():
    options = {"runs": 4, "duration": 0.2, "workers": 1}
    one, other = (
        estbench.run("pendulum", ["rotated_ukf"], batch_size=size, **options).records["rotated_ukf"]
        for size in (1, 4)
    )
    np.testing.assert_array_equal(one["mse"], other["mse"])
    # numpy adds one column of numbers in another order than several.
    np.testing.assert_allclose(one["anees"], other["anees"], rtol=1e-14)


def test_a_mode_has_another_rotation_in_each_step():
    """A mode starts anew in each prediction; its random numbers must not."""
    model = nonlinear_model(2)
    mean, cov, u = prior(model, 2)
    imm = IMM(model, base="rotated_ukf")
    belief = imm.init(mean, cov, np.array([3, 4], np.uint64))
    for k in range(1, 3):
        belief = imm.predict(belief, u, 0.1 * k, 0.1)
        for mode in belief.beliefs:
            np.testing.assert_array_equal(mode.counter, [k, k])
            np.testing.assert_array_equal(mode.keys, [3, 4])


def test_few_runs_are_updated_alone():
    model = nonlinear_model(4)
    mean, cov, u = prior(model, 16)
    filter = RotatedUKF(model)
    belief = filter.predict(filter.init(mean, cov), u, 0.0, 0.1)
    chosen = np.arange(16) == 5
    rows = run_subset.some(belief, chosen)
    y = model.measurement(mean, u, 0.0) + 0.1
    part, _ = filter.update(run_subset.take(belief, rows), y[rows], u[rows], 0.1)
    whole, _ = filter.update(belief, y, u, 0.1)
    after = run_subset.put(belief, rows, part)
    np.testing.assert_allclose(after.mean[5], whole.mean[5], atol=1e-13)
    np.testing.assert_array_equal(after.mean[~chosen], belief.mean[~chosen])
    np.testing.assert_array_equal(after.counter, 1 + chosen)


@pytest.mark.parametrize(("name", "limit"), [("ball", 0.35), ("free", 0.05)])
def test_half_a_radian_of_a_ball_and_of_a_free_joint(name, limit):
    """P after 0.2 s against 20,000 samples, seeded.

    Gravity turns the ball joint, not the free one. The axes of the `ckf` leave an error of 0.55
    in the ball joint's P; the fixed radius, whose fourth moments are too small, leaves 0.32.
    """
    model = mujoco_model(name)
    space = model.space
    x, u = random_states(model.mjmodel, 1, seed=1, scale=0.5)
    std = np.where(np.arange(space.n) < space.n // 2, 0.5, 0.3)
    rng = np.random.default_rng(0)
    points = space.plus(x[:, None], std * rng.standard_normal((1, 20_000, space.n)))
    images = model.transition(points, u, 0.0, 0.2)
    mean = space.mean(images, np.full(20_000, 1 / 20_000))
    residual = space.minus(images, mean[:, None])
    whiten = np.linalg.inv(np.linalg.cholesky(residual[0].T @ residual[0] / 20_000))
    filter = RotatedUKF(model, omega=0.0, centre_weight=0.0, rotations=30)
    ahead = filter.predict(filter.init(x, np.diag(std**2)[None]), u, 0.0, 0.2)
    assert np.abs(whiten @ space.minus(ahead.mean, mean)[0]).max() < 0.05
    assert np.abs(whiten @ ahead.cov[0] @ whiten.T - np.eye(space.n)).max() < limit


class Along:
    """The direction of the first of four coordinates."""

    count = 1

    def __call__(self, x):
        return np.tile(np.eye(4)[:, :1], (len(x), 1, 1))


class Place(FunctionModel):
    """A place, on which three other coordinates do not depend."""

    symmetries = Along()


def test_points_along_a_symmetry_keep_an_axis_of_their_own():
    """The readings then say nothing of the place, and something of it by chance without it."""

    def move(x, u, t, dt):
        inner = np.abs(x[..., 1:]) - 0.3
        return np.concatenate([x[..., :1], inner], axis=-1)

    model = Place(move, lambda x, u, t: np.abs(x[..., 1:]), 1e-4 * np.eye(4), 0.01 * np.eye(3))
    runs, u = 3, np.zeros((3, 0))
    rng = np.random.default_rng(0)
    mean, y = rng.standard_normal((2, runs, 4))
    cov = random_cov(rng, 4, runs, 0.5)
    cov[:, 0, 1:] = cov[:, 1:, 0] = 0.0
    for symmetries in (True, False):
        filter = RotatedUKF(model, symmetries=symmetries)
        begun = filter.init(mean, cov)
        xi = filter.rule_at(begun, PREDICTION)
        np.testing.assert_allclose(xi.cross(xi.points, xi.points), np.tile(np.eye(4), (3, 1, 1)),
                                   atol=1e-12)  # fmt: skip
        alone = filter.init(mean[1:2], cov[1:2], np.array([1], np.uint64))
        np.testing.assert_array_equal(filter.rule_at(alone, PREDICTION).points, xi.points[1:2])
        ahead = filter.predict(begun, u, 0.0, 1.0)
        after, _ = filter.update(ahead, y[:, 1:], u, 1.0)
        for belief in (ahead, after):
            place = np.abs(belief.mean[:, 0] - mean[:, 0]), np.abs(belief.cov[:, 0, 1:]).max(axis=1)
            assert bool(np.max(place) < 1e-12) is symmetries
        exact = cov[:, 0, 0] + 1e-4
        assert np.allclose(after.cov[:, 0, 0], exact, rtol=1e-12) is symmetries
    # A place that is known exactly: P has no Cholesky factor.
    filter, cov = RotatedUKF(model, symmetries=True), cov * (np.arange(4) > 0)
    after, _ = filter.update(filter.init(mean, cov * (np.arange(4) > 0)[:, None]), y[:, 1:], u, 0.0)
    np.testing.assert_array_equal(after.mean[:, 0], mean[:, 0])
    assert (after.fault == 0).all()


def test_symmetries_of_a_model_that_has_none():
    with pytest.raises(EstimatorError, match="RotatedUKF: symmetries is true, but the model has n"):
        RotatedUKF(nonlinear_model(2), symmetries=True)
    with pytest.raises(EstimatorError, match="but place and heading are symmetries of one robot"):
        RotatedUKF(mujoco_model("ball"), symmetries=True)
