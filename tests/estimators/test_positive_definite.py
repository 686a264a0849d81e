import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estbench.estimators import registry
from tests.helpers import (
    CENTERED,
    DISCRETE,
    EXACT,
    SAMPLED,
    linear_model,
    mujoco_model,
    nonlinear_model,
    random_cov,
    random_states,
)

seeds = st.integers(0, 2**32 - 1)
RUNS, STEPS = 3, 4


def assert_positive_definite(cov):
    scale = np.abs(cov).max()
    np.testing.assert_allclose(cov, np.swapaxes(cov, -1, -2), rtol=0, atol=1e-14 * scale)
    assert np.linalg.eigvalsh(cov).min() > 0


def prior(model, rng, scale=1.0):
    """Estimate, covariance and a truth drawn from them."""
    n = model.space.n
    x, P = scale * rng.standard_normal((RUNS, n)), random_cov(rng, n, RUNS, scale**2)
    return x, P, x + draw(rng, P)


def draw(rng, cov):
    return (np.linalg.cholesky(cov) @ rng.standard_normal((RUNS, cov.shape[-1], 1)))[..., 0]


def posteriors(name, model, rng, scale):
    filter = registry.create(name, {}, model)
    x, P, truth = prior(model, rng, scale)
    belief, R = filter.init(x, P), np.broadcast_to(model.R, (RUNS, *model.R.shape))
    for step in range(STEPS):
        u, t = rng.standard_normal((RUNS, 1)), 0.1 * step
        truth = model.transition(truth, u, t, 0.1)
        belief = filter.predict(belief, u, t, 0.1)
        before = filter.cov(belief)
        y = model.measurement(truth, u, t + 0.1) + draw(rng, R)
        belief, innovation = filter.update(belief, y, u, t + 0.1)
        assert_positive_definite(innovation.cov)
        yield before, filter.cov(belief)


@pytest.mark.parametrize("name", DISCRETE)
@given(seed=seeds, n=st.integers(1, 4), m=st.integers(1, 3))
def test_on_random_linear_models(name, seed, n, m):
    model = linear_model(seed, n, m)
    for before, after in posteriors(name, model, np.random.default_rng(seed), 1.0):
        assert_positive_definite(before)
        assert_positive_definite(after)
        if name in EXACT:  # a measurement never takes knowledge away
            taken = np.linalg.eigvalsh(before - after)
            assert taken.min() > -1e-12 * np.abs(before).max()


@pytest.mark.parametrize("name", DISCRETE)
@given(seed=seeds, n=st.sampled_from([2, 4]))
def test_on_a_nonlinear_model(name, seed, n):
    for before, after in posteriors(name, nonlinear_model(n), np.random.default_rng(seed), 0.3):
        assert_positive_definite(before)
        assert_positive_definite(after)


@pytest.mark.parametrize("name", DISCRETE)
@pytest.mark.parametrize("body", ["free", "ball"])
def test_attitudes_stay_unit_quaternions(name, body):
    if name == "ghkf" and body == "free":
        pytest.skip("3^12 points")
    model = mujoco_model(body, density={"*.w?": 0.1, "*.r?": 0.1} if body == "ball" else 0.1)
    space, output, dt = model.space, model.output(), 0.01
    start = space.quaternions[0, 0]
    truth, u = random_states(model.mjmodel, RUNS, scale=1.0)
    # In 12 dimensions few particles survive a resampling without regularization.
    filter = registry.create(name, {"regularization": 0.3} if name == "pf" else {}, model)
    rng = np.random.default_rng(0)
    P = 0.05 * random_cov(rng, space.n, RUNS)
    belief = filter.init(space.plus(truth, draw(rng, P)), P)
    for _ in range(STEPS):
        truth = model.transition(truth, u, 0.0, dt)
        belief = filter.predict(belief, u, 0.0, dt)
        y = model.measurement(truth, u, 0.0)
        y = output.plus(y, 0.1 * rng.standard_normal((RUNS, output.n)))
        flipped = y.copy()
        flipped[:, :4] *= -1  # the same rotation
        other, _ = filter.update(belief, flipped, u, 0.0)
        belief, _ = filter.update(belief, y, u, 0.0)
        np.testing.assert_allclose(filter.mean(other), filter.mean(belief), atol=1e-9)
        np.testing.assert_allclose(filter.cov(other), filter.cov(belief), atol=1e-9)
        norm = np.linalg.norm(filter.mean(belief)[:, start : start + 4], axis=1)
        np.testing.assert_allclose(norm, 1.0, rtol=1e-10, atol=1e-13)
        if name not in SAMPLED or body == "ball":  # in 12 dimensions few particles survive
            assert_positive_definite(filter.cov(belief))
    error = space.minus(truth, filter.mean(belief))[:, space.index("root.rx") :][:, :3]
    assert np.linalg.norm(error, axis=1).max() < 0.4


@pytest.mark.parametrize("name", EXACT)
def test_a_nan_attitude_reading_fails_its_run_only(name):
    model = mujoco_model("ball", channels=["attitude"], density=0.1)
    x, u = random_states(model.mjmodel, 2)
    filter = registry.create(name, {}, model)
    y = model.measurement(x, u, 0.0)
    y[1] = np.nan
    belief = filter.init(x, 0.01 * np.broadcast_to(np.eye(6), (2, 6, 6)))
    belief, _ = filter.update(belief, y, u, 0.0)
    assert belief.fault[0] == 0
    assert belief.fault[1] > 0
    assert np.isnan(filter.mean(belief)[1]).all()


@pytest.mark.parametrize("name", [name for name in EXACT if name not in ("iekf", "iplf", "ipls")])
def test_the_posterior_covariance_is_in_the_tangent_at_the_posterior(name):
    # Attitude and rate are measured in the state's own tangent, so H = I and even a large update is
    # linear there: P⁺ = J (P - P (P + R)⁻¹ P) Jᵀ with J the reset Jacobian of the correction.
    model = mujoco_model("ball", channels=["attitude", "gyro"], differences=CENTERED)
    space, R = model.space, model.measurement_noise(0.0)
    x, u = random_states(model.mjmodel, 1)
    P = 0.2 * random_cov(np.random.default_rng(1), 6)
    step = np.array([0.6, -0.3, 0.4, 0.1, 0.2, 0.3])
    filter = registry.create(name, {}, model)
    y = model.measurement(space.plus(x, step), u, 0.0)
    posterior, innovation = filter.update(filter.init(x, P[None]), y, u, 0.0)
    K = P @ np.linalg.inv(P + R)
    J = space.reset_jacobian(K @ step)
    np.testing.assert_allclose(innovation.residual[0], step, atol=1e-9)
    np.testing.assert_allclose(space.minus(filter.mean(posterior), x)[0], K @ step, atol=1e-8)
    np.testing.assert_allclose(filter.cov(posterior)[0], J @ (P - K @ P) @ J.T, atol=1e-8)
    assert not np.allclose(filter.cov(posterior)[0], P - K @ P, atol=1e-4)
