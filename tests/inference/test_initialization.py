import numpy as np
import pytest

from estbench.errors import EstimatorError, ScenarioError
from estbench.estimators import registry
from estbench.estimators.ekf import EKF
from estbench.experiment import setup
from estbench.inference.initialization import WarmStart, at_rest, displaced
from estbench.models.function import FunctionModel
from estbench.montecarlo import run as experiment
from estbench.spaces.manifold import Manifold
from tests.helpers import linear_model, random_cov

DT = 0.1


def drive(estimator, mean, cov, controls, ys, masks=None):
    """The beliefs after each of the predictions and updates."""
    belief, out, innovations = estimator.init(mean, cov), [], []
    for k, (u, y) in enumerate(zip(controls, ys)):
        belief = estimator.predict(belief, u, k * DT, DT)
        mask = None if masks is None else masks[k]
        belief, innovation = estimator.update(belief, y, u, (k + 1) * DT, None, mask)
        out.append(belief)
        innovations.append(innovation)
    return out, innovations


def linear_problem(seed, steps=6, runs=3):
    model = linear_model(seed)
    rng = np.random.default_rng(seed)
    controls, ys = rng.standard_normal((steps, runs, 1)), rng.standard_normal((steps, runs, 2))
    return model, rng.standard_normal((runs, 3)), random_cov(rng, 3, runs), controls, ys


def angle(model_noise=1e-4):
    """A slowly turning arm whose tip's precise position is measured: x = (angle, rate)."""
    return FunctionModel(
        lambda x, u, t, dt: np.stack([x[..., 0] + dt * x[..., 1], x[..., 1]], axis=-1),
        lambda x, u, t: np.stack([np.cos(x[..., 0]), np.sin(x[..., 0])], axis=-1),
        np.diag([0.0, model_noise]), 1e-4 * np.eye(2), names=("angle", "rate"),
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(3))
def test_on_a_linear_model_the_batch_start_is_the_filter_itself(seed):
    """No reading is used twice and none is lost: after the window both have the same belief."""
    model, mean, cov, controls, ys = linear_problem(seed)
    masks = np.random.default_rng(seed).random((6, 3, 2)) > 0.2
    cold, _ = drive(EKF(model), mean, cov, controls, ys, masks)
    warm, seen = drive(
        WarmStart(EKF(model), model, 3 * DT, "batch"), mean, cov, controls, ys, masks
    )
    for k in range(3, 6):
        np.testing.assert_allclose(warm[k].belief.mean, cold[k].mean, atol=1e-8)
        np.testing.assert_allclose(warm[k].belief.cov, cold[k].cov, atol=1e-8)
    for innovation in seen[:3]:
        assert not innovation.dof.any()
        assert not innovation.nis.any()
    np.testing.assert_array_equal(seen[3].dof, masks[3].sum(axis=1))


def test_until_it_starts_the_estimate_is_the_prior_carried_along():
    model, mean, cov, controls, ys = linear_problem(4)
    warm, _ = drive(WarmStart(EKF(model), model, 0.35, "batch"), mean, cov, controls, ys)
    belief = EKF(model).init(mean, cov)
    for k in range(4):  # readings up to the first time that is not before 0.35 s
        belief = EKF(model).predict(belief, controls[k], k * DT, DT)
        np.testing.assert_array_equal(warm[k].belief.mean, belief.mean)
        np.testing.assert_array_equal(warm[k].belief.cov, belief.cov)
        assert warm[k].prior is not None
    assert warm[4].prior is None


def test_where_one_linearization_fails_the_fit_does_not():
    """The tip is seen to 1 cm and the first guess is 1.5 rad off."""
    model, rng = angle(), np.random.default_rng(0)
    runs, steps = 200, 12
    x = np.array([0.3, 0.5]) + rng.standard_normal((runs, 2)) * [0.05, 0.1]
    u, ys, xs = np.zeros((runs, 0)), [], []
    for _ in range(steps):
        x = model.transition(x, u, 0.0, DT) + rng.standard_normal((runs, 2)) * [0.0, 1e-2]
        xs.append(x)
        ys.append(model.measurement(x, u) + 1e-2 * rng.standard_normal((runs, 2)))
    mean, cov = np.tile([1.8, 0.0], (runs, 1)), np.tile(np.diag([2.0, 1.0]), (runs, 1, 1))

    def nees(estimator):
        beliefs, _ = drive(estimator, mean, cov, [u] * steps, ys)
        e, P = xs[-1] - estimator.mean(beliefs[-1]), estimator.cov(beliefs[-1])
        return np.einsum("ri,rij,rj->r", e, np.linalg.inv(P), e).mean() / 2

    assert nees(EKF(model)) > 5
    assert nees(WarmStart(EKF(model), model, 0.5, "batch")) == pytest.approx(1.0, abs=0.2)


def test_the_static_start_is_the_mean_of_the_readings_of_a_robot_at_rest():
    """Ten readings of a state that is measured directly, with a wide prior on its position."""
    model = FunctionModel(
        lambda x, u, t, dt: np.stack([x[..., 0] + dt * x[..., 1], x[..., 1]], axis=-1),
        lambda x, u, t: x[..., :1], np.diag([0.0, 1e-6]), 0.04 * np.eye(1),
    )  # fmt: skip
    rng = np.random.default_rng(3)
    ys = [2.0 + 0.2 * rng.standard_normal((4, 1)) for _ in range(11)]
    prior = at_rest(np.array([0.0, 7.0]), 100.0 * np.eye(2), slice(1, 2), slice(1, 2), 0.01)
    mean, cov = (np.repeat(a[None], 4, axis=0) for a in prior)
    warm = WarmStart(EKF(model), model, 10 * DT, "static")
    beliefs, _ = drive(warm, mean, cov, [np.zeros((4, 0))] * 11, ys)
    alone = warm._fitted(beliefs[9], beliefs[9].prior)
    expected = np.sum(ys[:10], axis=0) / 0.04 / (10 / 0.04 + 1 / 100)
    np.testing.assert_allclose(alone.mean[:, :1], expected, atol=1e-8)
    np.testing.assert_allclose(alone.mean[:, 1], 0.0, atol=1e-12)
    one = np.diag([1 / (10 / 0.04 + 1 / 100), 1e-4])
    np.testing.assert_allclose(alone.cov, np.tile(one, (4, 1, 1)), atol=1e-9)


def test_a_run_that_cannot_be_fitted_keeps_its_prior():
    model, mean, cov, controls, ys = linear_problem(5)
    ys[1, 2] = np.nan
    beliefs, _ = drive(WarmStart(EKF(model), model, 2 * DT, "batch"), mean, cov, controls, ys)
    assert np.isfinite(beliefs[-1].belief.mean).all()
    np.testing.assert_array_equal(beliefs[-1].fault, 0)


def test_displaced_by_pattern():
    space = Manifold.euclidean(2, ("arm", "arm.vel"))
    mean, cov = displaced(space, np.ones(2), np.array([[4.0, 1.0], [1.0, 9.0]]),
                          {"arm": 0.5}, {"*.vel": 3.0})  # fmt: skip
    np.testing.assert_array_equal(mean, [1.5, 1.0])
    np.testing.assert_array_equal(cov, [[4.0, 3.0], [3.0, 81.0]])


def prepared(*overrides, robot="pendulum"):
    return setup.build(experiment.resolve(robot, ["ekf"], duration=0.3, overrides=overrides))


def test_the_scenarios_start_and_an_estimators_own():
    ready = prepared("start.offset.hinge=0.5", "estimators.ekf.start.inflate=3.0")
    mean, cov = ready.prior("ekf")
    np.testing.assert_allclose(mean - ready.mean, [0.5, 0.0])
    np.testing.assert_allclose(cov, 9.0 * ready.cov)
    assert type(ready.estimator("ekf")) is EKF
    other = prepared("estimators.ekf.start.method=batch", "start.window=0.1").estimator("ekf")
    assert isinstance(other, WarmStart)
    assert (other.window, other.method) == (0.1, "batch")


def test_the_truth_does_not_depend_on_the_start():
    runs = range(3)
    a = prepared().simulator(runs).x
    b = prepared("start.offset.hinge=0.5", "start.inflate=10.0").simulator(runs).x
    np.testing.assert_array_equal(a, b)


def test_a_static_start_of_a_robot_with_quaternions():
    ready = prepared("start.method=static", "start.window=0.1", robot="quadrotor")
    mean, cov = ready.prior("ekf")
    assert not mean[7:].any()
    np.testing.assert_allclose(np.diag(cov)[6:], 0.01**2)
    results = experiment.run(
        "quadrotor", ["ekf"], runs=4, duration=0.3,
        overrides=["start.method=static", "start.window=0.1", "initial.std=0.01"],
    )  # fmt: skip
    assert results["ekf"].diverged == 0


@pytest.mark.parametrize("estimator", ["enkf", "pf", "bias_ekf", "imm", "sr_ukf"])
def test_a_filter_of_any_family_can_be_started(estimator):
    options = ["start.method=batch", "start.window=0.1", "start.inflate=5.0"]
    results = experiment.run(
        "pendulum", [estimator], runs=4, duration=0.3, overrides=options, batch_size=2
    )
    whole = experiment.run(
        "pendulum", [estimator], runs=4, duration=0.3, overrides=options, batch_size=4
    )
    assert results[estimator].diverged == 0
    np.testing.assert_allclose(
        results.records[estimator]["anees"], whole.records[estimator]["anees"], rtol=1e-6
    )


def test_a_late_reading_of_the_window_is_fitted_too():
    """Exact delay handling goes back into the window, and the fit is made again."""
    late = ["channels.encoder.latency=0.05", "start.method=batch", "start.window=0.05",
            "start.inflate=20.0", "start.offset.hinge=0.5"]  # fmt: skip
    results = experiment.run("pendulum", ["ekf"], runs=30, duration=0.5, overrides=late)
    prompt = experiment.run("pendulum", ["ekf"], runs=30, duration=0.5, overrides=late[1:])
    np.testing.assert_allclose(results["ekf"].rmse[0].value, prompt["ekf"].rmse[0].value, rtol=0.5)
    assert results["ekf"].anees.value < 1.5


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("start.window=0.4", "ekf: start.window is 0.4 s but the run only 0.3 s; shorten it"),
        ("start.inflate=0.0", "start.inflate is 0 for hinge; use a factor above 0"),
        ("start.inflate={hing=2.0}", r"start.inflate: 'hing' matches none \(did you mean 'hinge'"),
        ("start.method=bach", "start.method: Input should be 'prior', 'batch' or 'static'"),
        ("estimators.ekf.start=3", "estimators.ekf.start is 3; use a table"),
        ("estimators.ekf.start.inflat=3", r"start.inflat: unknown key \(did you mean 'inflate'"),
        ("estimators.ekf.start.window=0.0", "ekf.start.window: Input should be greater than 0"),
    ],
)
def test_a_bad_start(override, message):
    with pytest.raises((EstimatorError, ScenarioError), match=message):
        prepared("start.method=batch", override)


def test_a_smoother_needs_no_fit():
    model = linear_model(0)
    with pytest.raises(EstimatorError, match=r"RTS: start.method is 'batch', but a smoother"):
        WarmStart(registry.create("rts", {}, model), model, 0.1, "batch")
