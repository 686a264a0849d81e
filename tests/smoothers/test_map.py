import numpy as np
import pytest

from estbench.errors import DimensionError
from estbench.estimators.beliefs import Fault, Gaussian
from estbench.estimators.ekf import EKF
from estbench.estimators.protocol import Measurement
from estbench.models.differences import Differences
from estbench.models.function import FunctionModel
from estbench.smoothers.map import map_estimate
from estbench.smoothers.rts import rts
from tests.estimators.test_enkf import start
from tests.helpers import CENTERED, mujoco_model, nonlinear_model, random_states
from tests.smoothers.test_rts import batch, filtered, linear_problem


def gaussian(mean, cov):
    return Gaussian(mean, cov, np.zeros(len(mean), np.uint8))


@pytest.mark.parametrize("seed", range(3))
def test_equals_the_batch_solution_and_rts_on_a_linear_model(seed):
    """In one step, although Q is singular."""
    model, mean, cov, controls, ys, masks = linear_problem(seed)
    assert np.linalg.matrix_rank(model.Q) < 3
    seen = [np.where(m, y, np.nan) for m, y in zip(masks, ys)]
    measured = [
        [Measurement(y, controls[max(k - 1, 0)], mask=m)]
        for k, (y, m) in enumerate(zip(seen, masks))
    ]
    times = list(range(8))
    result = map_estimate(model, gaussian(mean, cov), controls, times, measured)
    assert result.converged.all()
    np.testing.assert_array_equal(result.iterations, 2)
    posteriors, _ = filtered(model, EKF(model), mean, cov, controls, seen, 1.0, masks)
    smoothed = rts(model, posteriors, controls, times)
    for i in range(3):
        inputs = [u[i] for u in controls]
        means, covs = batch(model, mean[i], cov[i], inputs, ys[:, i], masks[:, i])
        for k, (belief, other) in enumerate(zip(result.beliefs, smoothed)):
            np.testing.assert_allclose(belief.mean[i], means[k], rtol=1e-10, atol=1e-10)
            np.testing.assert_allclose(belief.cov[i], covs[k], rtol=1e-10, atol=1e-10)
            np.testing.assert_allclose(belief.mean[i], other.mean[i], rtol=1e-10, atol=1e-10)
            np.testing.assert_allclose(belief.cov[i], other.cov[i], rtol=1e-10, atol=1e-10)


def cost(model, prior, controls, times, measured, xs):
    """The sum of squares that the estimate minimizes, one run."""
    space = model.space
    d = space.minus(xs[0], prior.mean)[0]
    total = d @ np.linalg.solve(prior.cov[0], d)
    for k, u in enumerate(controls):
        dt = times[k + 1] - times[k]
        w = space.minus(xs[k + 1], model.transition(xs[k], u, times[k], dt))[0]
        total += w @ np.linalg.solve(model.process_noise(xs[k], u, times[k], dt), w)
    for k, at_once in enumerate(measured):
        for z in at_once:
            output = model.output(z.channels)
            h = model.measurement(xs[k], z.u, times[k], z.channels)
            v = output.minus(z.y, h)[0]
            total += v @ np.linalg.solve(model.measurement_noise(times[k], z.channels), v)
    return total


def is_stationary(model, prior, controls, times, measured, result, step=1e-4, tolerance=1e-5):
    xs = [b.mean for b in result.beliefs]
    for k in range(len(xs)):
        for e in step * np.eye(model.space.n):
            change = [
                cost(model, prior, controls, times, measured, [*xs[:k], moved, *xs[k + 1 :]])
                for moved in (model.space.plus(xs[k], s * e) for s in (1, -1))
            ]
            slope, curvature = (
                change[0] - change[1],
                sum(change) - 2 * cost(model, prior, controls, times, measured, xs),
            )
            assert abs(slope) < tolerance * max(1.0, np.sqrt(curvature) / step) * step * 2
    return True


def test_nonlinear_minimum():
    model, dt = nonlinear_model(2), 0.3
    mean, cov, u = start(model, 1)
    times = [k * dt for k in range(6)]
    rng = np.random.default_rng(0)
    measured = [
        [Measurement(model.measurement(mean, u, 0.0) + 0.2 * rng.standard_normal((1, 2)), u)]
        if k != 2 else [] for k in range(6)
    ]  # fmt: skip
    prior = gaussian(mean, cov)
    result = map_estimate(model, prior, [u] * 5, times, measured, iterations=60)
    assert result.converged.all()
    assert result.iterations[0] > 2
    assert is_stationary(model, prior, [u] * 5, times, measured, result)


def in_units(unit):
    """A pendulum whose start is far off, with its state in other units: the same problem."""
    model = FunctionModel(
        lambda x, u, t, dt: unit * stepped(x / unit, dt),
        lambda x, u, t: np.sin(x[..., :1] / unit),
        unit**2 * 1e-3 * np.eye(2), 1e-4 * np.eye(1),
        differences=Differences("centered", 1e-5 * unit),
    )  # fmt: skip
    u, times = np.empty((1, 0)), [0.2 * k for k in range(8)]
    x, measured = np.array([[2.2, -0.5]]), []
    for _ in times:
        measured.append([Measurement(np.sin(x[:, :1]), u)])
        x = stepped(x, 0.2)
    prior = gaussian(np.zeros((1, 2)), unit**2 * np.array([[[4.0, 0.0], [0.0, 1.0]]]))
    return map_estimate(
        model=model, prior=prior, controls=[u] * 7, times=times, measurements=measured,
        iterations=200, tolerance=1e-6 * unit,
    )  # fmt: skip


def stepped(x, dt):
    rate = x[..., 1] - dt * np.sin(x[..., 0])
    return np.stack([x[..., 0] + dt * rate, rate], axis=-1)


def test_the_unit_of_the_state_does_not_matter():
    one, other = in_units(1.0), in_units(1e-4)
    assert one.converged.all()
    assert one.iterations[0] > 4
    np.testing.assert_array_equal(one.iterations, other.iterations)
    for a, b in zip(one.beliefs, other.beliefs):
        np.testing.assert_allclose(a.mean, 1e4 * b.mean, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(a.cov, 1e8 * b.cov, rtol=1e-4, atol=1e-7)


def test_minimum_on_a_robot_with_quaternions():
    """Large rotational residuals, so that the carrying between tangents matters."""
    model = mujoco_model("joints", density=5.0, differences=CENTERED)
    x, u = random_states(model.mjmodel, 1, seed=3)
    n, dt, rng = model.space.n, 0.02, np.random.default_rng(1)
    prior = gaussian(x, 0.3 * np.eye(n)[None])
    times, measured = [0.0, dt, 2 * dt], []
    for channels in (None, ("wrist_quat", "gyro"), ("attitude",)):
        output = model.output(channels)
        y = model.measurement(x, u, 0.0, channels)
        noise = 0.3 * rng.standard_normal((1, output.n))
        measured.append([Measurement(output.plus(y, noise), u, channels)])
    result = map_estimate(
        model, prior, [u] * 2, times, measured, iterations=60, tolerance=1e-8, covariance=False
    )
    assert result.converged.all()
    assert is_stationary(model, prior, [u] * 2, times, measured, result, tolerance=1e-3)


def test_a_window_started_from_the_solution_stays_there():
    model, mean, cov, controls, ys, _ = linear_problem(4)
    measured = [[Measurement(y, controls[max(k - 1, 0)])] for k, y in enumerate(ys)]
    first = map_estimate(model, gaussian(mean, cov), controls, list(range(8)), measured)
    again = map_estimate(
        model, gaussian(mean, cov), controls, list(range(8)), measured,
        start=[b.mean for b in first.beliefs], covariance=False,
    )  # fmt: skip
    np.testing.assert_array_equal(again.iterations, 1)
    np.testing.assert_array_equal(again.beliefs[3].cov, 0)


def test_runs_do_not_depend_on_the_batch_and_a_failed_one_stands_alone():
    model, dt = nonlinear_model(4), 0.1
    mean, cov, u = start(model, 4)
    times, x = [k * dt for k in range(5)], mean + 0.1
    cov, ys = 0.2 * cov, []
    for _ in times:
        ys.append(model.measurement(x, u, 0.0))
        x = model.transition(x, u, 0.0, dt)
    ys[3][1] = np.nan

    def estimate(rows):
        measured = [[Measurement(y[rows], u[rows])] for y in ys]
        return map_estimate(
            model, gaussian(mean[rows], cov[rows]), [u[rows]] * 4, times, measured, iterations=60
        )

    whole, part = estimate(slice(0, 4)), estimate(slice(2, 4))
    np.testing.assert_array_equal(whole.converged, [True, False, True, True])
    for belief, other in zip(whole.beliefs, part.beliefs):
        np.testing.assert_array_equal(belief.fault, [0, Fault.STATE, 0, 0])
        np.testing.assert_array_equal(belief.mean[2:], other.mean)
        np.testing.assert_array_equal(belief.cov[2:], other.cov)
        assert np.isnan(belief.mean[1]).all()


def test_lists_that_do_not_fit_say_so():
    model, mean, cov, controls, *_ = linear_problem(1)
    with pytest.raises(DimensionError, match="0 beliefs, 7 controls and 8 times"):
        map_estimate(model, gaussian(mean, cov), controls, list(range(8)), [])


def test_halving_the_step_converges_where_plain_gauss_newton_cycles():
    """Measurements 5 σ off: the full steps go back and forth by 0.86 for ever."""
    model, dt = nonlinear_model(4), 0.1
    mean, cov, u = (a[3:] for a in start(model, 4))
    times = [k * dt for k in range(5)]
    measured = [[Measurement(model.measurement(mean, u, 0.0) + 0.05 * k, u)] for k in range(5)]
    prior = gaussian(mean, 0.2 * cov)
    result = map_estimate(model, prior, [u] * 4, times, measured, iterations=200, covariance=False)
    assert result.converged.all()
    assert is_stationary(model, prior, [u] * 4, times, measured, result)
