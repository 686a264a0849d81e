import numpy as np
import pytest

from estbench.errors import ScenarioError
from estbench.estimators.beliefs import Fault
from estbench.estimators.ekf import EKF
from estbench.estimators.schmidt import SchmidtEKF
from estbench.models.augmented import Augmented, Bias
from estbench.models.linear import LinearModel
from tests.estimators.test_enkf import start
from tests.helpers import linear_model, mujoco_model, nonlinear_model, random_states


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("n", "m", "e", "c"),
    [(2, 1, [0], [1]), (5, 3, [0, 2, 3], [1, 4]), (6, 2, [1, 5], [0, 2, 3, 4])],
)
def test_update_equals_the_textbook(n, m, e, c, seed):
    model = linear_model(seed, n, m)
    mean, cov, u = start(model, 3, seed)
    filter = SchmidtEKF(model, considered=[f"x{i}" for i in c])
    y = model.measurement(mean, u) + 0.5
    posterior, _ = filter.update(filter.init(mean, cov), y, u, 0.0)
    Hx, Hb = model.C[:, e], model.C[:, c]
    for i in range(3):  # Jazwinski's partitioned form
        Px, Pxb, Pb = (cov[i][np.ix_(*s)] for s in ((e, e), (e, c), (c, c)))
        S = Hx @ Px @ Hx.T + Hx @ Pxb @ Hb.T + Hb @ Pxb.T @ Hx.T + Hb @ Pb @ Hb.T + model.R
        K = (Px @ Hx.T + Pxb @ Hb.T) @ np.linalg.inv(S)
        nu = y[i] - model.measurement(mean[i : i + 1], u[i : i + 1])[0]
        np.testing.assert_allclose(
            posterior.mean[i, e], mean[i, e] + K @ nu, rtol=1e-10, atol=1e-10
        )
        np.testing.assert_array_equal(posterior.mean[i, c], mean[i, c])
        P = posterior.cov[i]
        np.testing.assert_allclose(P[np.ix_(e, e)], Px - K @ S @ K.T, rtol=1e-10, atol=1e-10)
        cross = Pxb - K @ (Hx @ Pxb + Hb @ Pb)
        np.testing.assert_allclose(P[np.ix_(e, c)], cross, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(P[np.ix_(c, c)], Pb, rtol=1e-10, atol=1e-12)


def test_nothing_considered_is_the_ekf():
    model = nonlinear_model(4)
    mean, cov, u = start(model, 3)
    y = model.measurement(mean, u, 0.0) + 0.2
    filter = SchmidtEKF(model)
    (a, _), (b, _) = (f.update(f.init(mean, cov), y, u, 0.0) for f in (filter, EKF(model)))
    np.testing.assert_allclose(a.mean, b.mean, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(a.cov, b.cov, rtol=1e-10, atol=1e-12)


def test_its_covariance_is_that_of_its_error():
    """With a constant bias nobody estimates, P is right; an EKF ignorant of it is overconfident."""
    model = LinearModel(np.eye(1), np.eye(1), 0.01 * np.eye(1), 0.04 * np.eye(1))
    runs, rng = 2000, np.random.default_rng(0)
    augmented = Augmented(model, (Bias("y0", 0.5),))
    filter, ignorant = SchmidtEKF(augmented, considered=("bias.*",)), EKF(model)
    u, x = np.empty((runs, 0)), rng.standard_normal((runs, 1))
    bias = 0.5 * rng.standard_normal((runs, 1))
    mean, cov = np.zeros((runs, 1)), np.ones((runs, 1, 1))
    a, b = filter.init(*augmented.augment(mean, cov)), ignorant.init(mean, cov)
    for k in range(30):
        x = x + 0.1 * rng.standard_normal((runs, 1))
        y = x + bias + 0.2 * rng.standard_normal((runs, 1))
        a, b = filter.predict(a, u, k, 1.0), ignorant.predict(b, u, k, 1.0)
        a, b = filter.update(a, y, u, k)[0], ignorant.update(b, y, u, k)[0]
    nees = ((a.mean[:, 0] - x[:, 0]) ** 2 / a.cov[:, 0, 0]).mean()
    assert abs(nees - 1) < 4 * np.sqrt(2 / runs)
    assert ((b.mean - x)[:, 0] ** 2 / b.cov[:, 0, 0]).mean() > 5


def test_missing_component_is_out_exactly():
    model = linear_model(3)
    mean, cov, u = start(model, 3)
    filter = SchmidtEKF(model, considered=("x0",))
    belief = filter.init(mean, cov)
    y = model.measurement(mean, u) + 0.5
    mask = np.array([[True, False], [False, False], [True, True]])
    posterior, innovation = filter.update(belief, np.where(mask, y, np.nan), u, 0.0, mask=mask)
    np.testing.assert_array_equal(innovation.dof, [1, 0, 2])
    np.testing.assert_array_equal(posterior.mean[1], mean[1])
    np.testing.assert_allclose(posterior.cov[1], cov[1], rtol=1e-10, atol=1e-15)
    assert model.D is not None
    part = LinearModel(model.A, model.C[:1], model.Q, model.R[:1, :1], model.B, model.D[:1])
    first, _ = SchmidtEKF(part, considered=("x0",)).update(belief, y[:, :1], u, 0.0)
    np.testing.assert_allclose(posterior.mean[0], first.mean[0], rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(posterior.cov[0], first.cov[0], rtol=1e-10, atol=1e-12)


def test_a_failed_run_stands_alone():
    model = linear_model(5)
    mean, cov, u = start(model, 4)
    mean[1], cov[2] = np.nan, -10 * np.eye(3)
    filter = SchmidtEKF(model, considered=("x2",))
    belief = filter.predict(filter.init(mean, cov), u, 0.0, 1.0)
    belief, _ = filter.update(belief, np.ones((4, 2)), u, 1.0)
    np.testing.assert_array_equal(belief.fault, [0, Fault.STATE, Fault.INNOVATION, 0])


def test_quaternion_states_with_considered_biases():
    inner = mujoco_model("joints", density=1e-3)
    model = Augmented.build(inner, bias={"gyro*": 0.1, "attitude*": 0.02})
    x, u = random_states(inner.mjmodel, 3)
    n = inner.space.n
    filter = SchmidtEKF(model, considered=("bias.*", "lift"))
    belief = filter.init(*model.augment(x, np.broadcast_to(1e-2 * np.eye(n), (3, n, n))))
    y = inner.measurement(x, u, 0.0) + 0.01
    posterior, _ = filter.update(belief, y, u, 0.0)
    np.testing.assert_array_equal(posterior.mean[:, -6:], 0)
    np.testing.assert_array_equal(posterior.mean[:, 0], x[:, 0])
    np.testing.assert_allclose(
        posterior.cov[:, -6:, -6:], belief.cov[:, -6:, -6:], rtol=1e-10, atol=1e-15
    )
    assert np.abs(posterior.mean - belief.mean).max() > 1e-3


def test_unknown_coordinates_say_so():
    with pytest.raises(ScenarioError, match=r"SchmidtEKF: considered: 'bias.*' matches none"):
        SchmidtEKF(linear_model(0), considered=("bias.*",))
