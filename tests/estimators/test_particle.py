import numpy as np
import pytest

from estbench.errors import EstimatorError
from estbench.estimators.beliefs import Fault
from estbench.estimators.ekf import EKF
from estbench.estimators.particle import RESAMPLING, ParticleFilter, systematic
from estbench.models.function import FunctionModel
from estbench.randomness import counter as random
from tests.estimators.test_enkf import start
from tests.helpers import linear_model, mujoco_model, nonlinear_model, random_states


def effective(belief):
    return 1 / np.exp(2 * belief.log_weights).sum(-1)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("n", [2, 4, 6])
def test_update_equals_the_textbook(n, seed):
    model = nonlinear_model(n)
    mean, cov, u = start(model, 3, seed)
    filter = ParticleFilter(model, size=80, threshold=1.0)
    never = ParticleFilter(model, size=80, threshold=0.0)
    belief = filter.predict(filter.init(mean, cov), u, 0.0, 0.05)
    y = model.measurement(mean, u, 0.0) + 0.1
    weighted, innovation = never.update(belief, y, u, 0.0)
    resampled, _ = filter.update(belief, y, u, 0.0)
    R = model.measurement_noise(0.0)
    for i in range(3):
        images = np.array(
            [model.measurement(p[None], u[i : i + 1], 0.0)[0] for p in belief.points[i]]
        )
        w = np.array([np.exp(-0.5 * (y[i] - h) @ np.linalg.solve(R, y[i] - h)) for h in images])
        w /= w.sum()
        np.testing.assert_allclose(np.exp(weighted.log_weights[i]), w, rtol=1e-10, atol=1e-10)
        m = w @ belief.points[i]
        P = sum(a * np.outer(p - m, p - m) for a, p in zip(w, belief.points[i]))
        np.testing.assert_allclose(never.mean(weighted)[i], m, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(never.cov(weighted)[i], P, rtol=1e-10, atol=1e-10)
        residual = y[i] - images.mean(0)
        S = np.cov(images.T, bias=True) + R
        assert np.isclose(innovation.nis[i], residual @ np.linalg.solve(S, residual))
        u0 = random.uniform(belief.keys[i : i + 1], belief.counter[i : i + 1], RESAMPLING, 1)[0, 0]
        j, chosen, total = 0, [], np.cumsum(w)
        for k in range(80):
            while (u0 + k) / 80 > total[j]:
                j += 1
            chosen.append(j)
        np.testing.assert_array_equal(resampled.points[i], belief.points[i][chosen])
        np.testing.assert_allclose(resampled.log_weights[i], -np.log(80))


def test_systematic_resampling_is_unbiased_and_never_picks_a_dead_particle():
    rng = np.random.default_rng(0)
    weights = rng.exponential(size=(4000, 6)) * np.array([1, 0, 3, 1, 0.1, 0])
    weights /= weights.sum(-1, keepdims=True)
    chosen = systematic(weights, rng.uniform(size=(4000, 1)))
    counts = np.stack([(chosen == j).sum(-1) for j in range(6)], axis=-1)
    assert (counts[:, [1, 5]] == 0).all()
    assert (np.abs(counts - 6 * weights) < 1).all()
    assert (np.abs((counts - 6 * weights).mean(0)) < 4 * 0.5 / np.sqrt(4000)).all()
    for comb in (1e-16, 1 - 1e-16):
        assert systematic(weights, np.full((4000, 1), comb)).max() <= 4


def deviation_from_kf(size, regularization, runs=150, steps=3):
    model = linear_model(2)
    mean, cov, u = start(model, 1)
    mean, cov, u = (np.repeat(a, runs, axis=0) for a in (mean, cov, u))
    filter, kf = ParticleFilter(model, size, regularization=regularization), EKF(model)
    a, b = filter.init(mean, cov), kf.init(mean, cov)
    for k in range(steps):
        a, b = filter.predict(a, u, k, 1.0), kf.predict(b, u, k, 1.0)
        y = model.measurement(b.mean, u) + 0.5
        a, b = filter.update(a, y, u, k)[0], kf.update(b, y, u, k)[0]
    white = np.linalg.inv(np.linalg.cholesky(b.cov))
    error = np.einsum("rij,rj->ri", white, filter.mean(a) - b.mean)
    shape = white @ filter.cov(a) @ np.swapaxes(white, -1, -2) - np.eye(3)
    return (error**2).sum(-1), (shape**2).sum((-1, -2))


@pytest.mark.parametrize("regularization", [0.0, 0.5])
def test_error_against_kf_falls_as_one_over_root_of_size(regularization):
    small = deviation_from_kf(200, regularization)
    large = deviation_from_kf(3200, regularization)
    for few, many in zip(small, large):
        # As in test_enkf: 4 standard errors about the ratio 16, 20 % for the order 1/size² at 200.
        errors = [a.std() / a.mean() / np.sqrt(len(a)) for a in (few, many)]
        assert abs(np.log(few.mean() / many.mean() / 16)) < 4 * np.hypot(*errors) + 0.2


def test_missing_component_is_out_exactly():
    model = linear_model(3)
    mean, cov, u = start(model, 3)
    filter = ParticleFilter(model, size=30)
    belief = filter.predict(filter.init(mean, cov), u, 0.0, 1.0)
    y = model.measurement(mean, u) + 0.2
    mask = np.array([[True, False], [False, False], [True, True]])
    posterior, innovation = filter.update(belief, np.where(mask, y, np.nan), u, 0.0, mask=mask)
    for name in ("points", "log_weights", "counter"):
        np.testing.assert_array_equal(getattr(posterior, name)[1], getattr(belief, name)[1])
    np.testing.assert_array_equal(innovation.dof, [1, 0, 2])
    assert innovation.nis[1] == 0
    full, _ = filter.update(belief, y, u, 0.0)
    np.testing.assert_array_equal(posterior.points[2], full.points[2])
    assert model.D is not None
    part = type(model)(model.A, model.C[:1], model.Q, model.R[:1, :1], model.B, model.D[:1])
    first, _ = ParticleFilter(part, size=30).update(belief, y[:, :1], u, 0.0)
    np.testing.assert_allclose(posterior.points[0], first.points[0])
    np.testing.assert_allclose(
        posterior.log_weights[0], first.log_weights[0], rtol=1e-10, atol=1e-12
    )


@pytest.mark.parametrize("regularization", [0.0, 0.7])
def test_runs_do_not_depend_on_the_batch(regularization):
    model = linear_model(4)
    mean, cov, u = start(model, 6)
    keys = np.arange(100, 106, dtype=np.uint64)
    filter = ParticleFilter(model, 25, 1.0, regularization)

    def run(rows):
        belief = filter.predict(filter.init(mean[rows], cov[rows], keys[rows]), u[rows], 0, 1)
        return filter.update(belief, np.ones((len(belief.points), 2)), u[rows], 1.0)[0].points

    np.testing.assert_array_equal(run(slice(0, 6))[2:4], run(slice(2, 4)))


def test_resampling_happens_below_the_threshold_only():
    model = linear_model(5)
    mean, cov, u = start(model, 40)
    filter = ParticleFilter(model, size=50, threshold=0.3)
    belief = filter.init(mean, cov)
    y = model.measurement(mean, u)
    plain, _ = ParticleFilter(model, size=50, threshold=0.0).update(belief, y, u, 0.0)
    posterior, _ = filter.update(belief, y, u, 0.0)
    due = effective(plain) < 0.3 * 50
    assert 0 < due.sum() < 40
    np.testing.assert_allclose(effective(posterior)[due], 50)
    np.testing.assert_array_equal(posterior.points[~due], plain.points[~due])


def test_regularization_makes_particles_distinct_and_keeps_the_moments():
    model = linear_model(6)
    mean, cov, u = start(model, 300)
    filter = ParticleFilter(model, 200, 1.0, regularization=1.0)
    belief = filter.init(mean, cov)
    y = model.measurement(mean, u)
    plain = ParticleFilter(model, 200, 0.0)
    weighted, _ = plain.update(belief, y, u, 0.0)
    posterior, _ = filter.update(belief, y, u, 0.0)
    assert all(len(np.unique(run[:, 0])) == 200 for run in posterior.points)
    ratio = np.trace(filter.cov(posterior), axis1=1, axis2=2) / np.trace(
        plain.cov(weighted), axis1=1, axis2=2
    )
    assert abs(ratio.mean() - 1) < 4 * ratio.std() / np.sqrt(300) + 1 / 200


def test_dead_particles_are_dropped_and_a_run_without_any_fails_alone():
    def f(x, u, t, dt):
        return np.where(x > 1.5, np.nan, x)  # the model has no answer above 1.5

    model = FunctionModel(f, lambda x, u, t: x, 1e-3 * np.eye(1), np.eye(1))
    mean, cov, u = (
        np.array([[0.0], [9.0], [1.4]]),
        np.tile(0.04 * np.eye(1), (3, 1, 1)),
        np.empty((3, 0)),
    )
    filter = ParticleFilter(model, size=50)
    belief = filter.predict(filter.init(mean, cov), u, 0.0, 1.0)
    np.testing.assert_array_equal(belief.fault, [0, Fault.STATE, 0])
    assert np.isfinite(belief.log_weights[0]).all()
    assert np.isneginf(belief.log_weights[2]).any()
    belief, _ = filter.update(belief, np.zeros((3, 1)), u, 1.0)
    assert np.isnan(filter.mean(belief)[1]).all()
    assert np.isnan(filter.cov(belief)[1]).all()
    assert np.isfinite(filter.cov(belief)[[0, 2]]).all()
    assert filter.mean(belief)[2, 0] < 1.5
    far, _ = filter.update(belief, np.array([[1e4], [0.0], [np.inf]]), u, 1.0)
    np.testing.assert_array_equal(far.fault, [Fault.WEIGHTS, Fault.STATE, Fault.STATE])


def test_a_two_peaked_belief_stays_two_peaked():
    model = FunctionModel(
        lambda x, u, t, dt: x, lambda x, u, t: x**2, 1e-4 * np.eye(1), 0.01 * np.eye(1)
    )
    filter = ParticleFilter(model, size=2000)
    u = np.empty((1, 0))
    belief = filter.init(np.zeros((1, 1)), np.ones((1, 1, 1)))
    for k in range(5):
        belief = filter.predict(belief, u, k, 1.0)
        belief, _ = filter.update(belief, np.ones((1, 1)), u, k)
    weight, x = np.exp(belief.log_weights[0]), belief.points[0, :, 0]
    assert 0.3 < weight[x > 0].sum() < 0.7
    assert weight @ (np.abs(x) - 1) ** 2 < 0.05**2


def test_quaternion_states_and_measurements():
    model = mujoco_model("joints", density=1e-4)
    x, u = random_states(model.mjmodel, 3)
    filter = ParticleFilter(model, size=100, regularization=0.3)
    cov = np.broadcast_to(1e-4 * np.eye(model.space.n), (3, model.space.n, model.space.n))
    belief = filter.predict(filter.init(x, cov), u, 0.0, 0.004)
    truth = model.transition(x, u, 0.0, 0.004)
    y = model.measurement(truth, u, 0.0)
    y[:, 1:9] *= -1  # -q is the same rotation
    belief, innovation = filter.update(belief, y, u, 0.0)
    assert not belief.fault.any()
    assert (innovation.nis < 1.0).all()
    assert np.abs(model.space.minus(filter.mean(belief), truth)).max() < 0.05


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"size": 0}, "ParticleFilter: size is 0; use an integer of at least 2"),
        ({"threshold": 1.5}, r"ParticleFilter: threshold is 1.5; use a number in \[0, 1\]"),
        ({"regularization": -1}, "ParticleFilter: regularization is -1"),
    ],
)
def test_wrong_settings_say_so(settings, words):
    with pytest.raises(EstimatorError, match=words):
        ParticleFilter(linear_model(0), **settings)


@pytest.mark.parametrize("n", [1, 12])
def test_weights_that_vanish_are_a_fault_of_their_own(n):
    # A prior of variance 1, a reading of 1e-4: of 1000 particles in 12 dimensions few are near it.
    model = FunctionModel(
        lambda x, u, t, dt: x, lambda x, u, t: x, 1e-6 * np.eye(n), 1e-4 * np.eye(n)
    )
    mean, cov = np.zeros((4, n)), np.tile(np.eye(n), (4, 1, 1))
    y, none = 0.1 * np.ones((4, n)), np.zeros((4, 0))
    for settings, lost in (({}, n == 12), ({"regularization": 0.7}, False)):
        filter = ParticleFilter(model, **settings)
        belief = filter.predict(filter.init(mean, cov), none, 0.0, 0.01)
        belief, _ = filter.update(belief, y, none, 0.01)
        np.testing.assert_array_equal(belief.fault, np.full(4, Fault.WEIGHTS if lost else 0))
        assert np.isnan(filter.mean(belief)).all() == lost
    assert "raise `size`, set `regularization`" in Fault.WEIGHTS.text
