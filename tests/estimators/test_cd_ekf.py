from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from estbench.errors import EstimatorError
from estbench.estimators.beliefs import Fault
from estbench.estimators.cd_ekf import ContinuousDiscreteEKF
from estbench.estimators.ekf import EKF
from estbench.estimators.kf import KF
from estbench.estimators.lkf import LKF
from estbench.estimators.sr_ekf import SquareRootEKF
from estbench.estimators.ukf import UKF
from estbench.models.continuous import ContinuousFunctionModel, integrate, integrate_moments
from estbench.models.differences import Differences
from estbench.models.linear import LinearModel
from estbench.models.noise import van_loan
from estbench.spaces import rotation
from estbench.spaces.manifold import Manifold
from tests.helpers import linear_model, nonlinear_model, random_cov


def van_der_pol(substeps=1) -> Any:
    return ContinuousFunctionModel(
        lambda x, u, t: np.stack(
            [x[..., 1], (1.0 - x[..., 0] ** 2) * x[..., 1] - x[..., 0] + u[..., 0]], axis=-1
        ),
        lambda x, u, t: x[..., :1] ** 2 + x[..., 1:],
        np.diag([0.01, 0.2]),
        0.1 * np.eye(1),
        n_controls=1,
        substeps=substeps,
        f_jacobian=lambda x, u, t: np.stack(
            [
                np.stack([0.0 * x[..., 0], 1.0 + 0.0 * x[..., 0]], axis=-1),
                np.stack([-2.0 * x[..., 0] * x[..., 1] - 1.0, 1.0 - x[..., 0] ** 2], axis=-1),
            ],
            axis=-2,
        ),
    )


class Tumbling:
    """A free rigid body: Euler's equations and attitude; x = (q, ω), a curved state."""

    inertia = np.array([1.0, 2.0, 3.0])
    space = Manifold(tuple("abcdef"), ("rad",) * 3 + ("rad/s",) * 3, np.array([[0, 0]]))
    nu = 0

    def flow(self, x, u, t):
        omega = x[..., 4:]
        torque = np.cross(self.inertia * omega, omega)
        return np.concatenate([omega, torque / self.inertia], axis=-1)

    def flow_jacobian(self, x, u, t):
        flat = Manifold.euclidean(6)
        return Differences("centered", 1e-5).jacobian(
            lambda p: self.flow(p, u, t), self.space, flat, x
        )

    def spectral_density(self, x, u, t):
        return np.diag([0.02, 0.01, 0.03, 0.1, 0.2, 0.3])


def state(seed, runs):
    rng = np.random.default_rng(seed)
    q = rotation.normalize(rng.standard_normal((runs, 4)))
    return np.concatenate([q, rng.standard_normal((runs, 3))], axis=-1)


def textbook(model, x, P, y, u, t, dt, substeps):
    """One run: x̂, Φ and Q̄ of Bishop's eq. 10 as one vector by RK4, then eq. 11, 17, 20 and 21."""
    n = len(x)

    def rates(t, s):
        x, Phi, Q = s[0], s[1 : n + 1], s[n + 1 :]
        F = model.f_jacobian(x, u, t)
        return np.vstack([model.f(x, u, t), F @ Phi, F @ Q + Q @ F.T + model.Q_s])

    s, h = np.vstack([x, np.eye(n), np.zeros((n, n))]), dt / substeps
    for k in range(substeps):
        a = rates(t + k * h, s)
        b = rates(t + k * h + h / 2, s + h / 2 * a)
        c = rates(t + k * h + h / 2, s + h / 2 * b)
        s = s + h / 6 * (a + 2 * b + 2 * c + rates(t + k * h + h, s + h * c))
    x, Phi, Q = s[0], s[1 : n + 1], s[n + 1 :]
    P = Phi @ P @ Phi.T + Q
    H = model.h_jacobian(x, u, t + dt)
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + model.R)
    return x + K @ (y - model.h(x, u, t + dt)), (np.eye(n) - K @ H) @ P


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("n", [2, 4, 6])
@pytest.mark.parametrize("substeps", [1, 3])
def test_equals_the_textbook(substeps, n, seed):
    """A chain of pendulums whose drive depends on time."""
    chain, rng, dt = nonlinear_model(n), np.random.default_rng(seed), 0.2
    model = ContinuousFunctionModel(  # the chain's own step is Euler's, x + dt ẋ
        lambda x, u, t: chain.f(x, u * np.cos(t), t, 1.0) - x, chain.h, chain.Q, chain.R,
        f_jacobian=lambda x, u, t: chain.f_jacobian(x, u, t, 1.0) - np.eye(n),
        h_jacobian=chain.h_jacobian, n_controls=1,
    )  # fmt: skip
    mean, cov = 0.3 * rng.standard_normal((2, n)), 0.1 * random_cov(rng, n, 2)
    estimator = ContinuousDiscreteEKF(model, substeps=substeps)
    belief, books = estimator.init(mean, cov), list(zip(mean, cov))
    for k in range(5):
        u = rng.standard_normal((2, 1))
        y = chain.h(mean, u, 0.0) + 0.2 * rng.standard_normal((2, n // 2 + 1))
        belief = estimator.predict(belief, u, k * dt, dt)
        belief, _ = estimator.update(belief, y, u, k * dt + dt)
        books = [
            textbook(model, *book, y[i], u[i], k * dt, dt, substeps) for i, book in enumerate(books)
        ]
    np.testing.assert_allclose(belief.mean, [x for x, _ in books], rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(belief.cov, [P for _, P in books], rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("method", ["rk4", "rk45"])
@pytest.mark.parametrize("seed", range(3))
def test_equals_bishops_equations_integrated_by_scipy(method, seed):
    """Bishop eq. 10 for one run, eq. 11, and the update by eq. 17, 20 and 21."""
    rng = np.random.default_rng(seed)
    model, dt = van_der_pol(), 0.3
    mean, cov = rng.standard_normal((3, 2)), random_cov(rng, 2, 3)
    u, y = rng.standard_normal((3, 1)), rng.standard_normal((3, 1))
    estimator = ContinuousDiscreteEKF(model, method=method, substeps=400, rtol=1e-11, atol=1e-12)
    belief = estimator.predict(estimator.init(mean, cov), u, 0.0, dt)
    posterior, _ = estimator.update(belief, y, u, dt)
    for run in range(3):

        def rates(t, s, run=run):
            x, Phi, Q = s[:2], s[2:6].reshape(2, 2), s[6:].reshape(2, 2)
            F = model.f_jacobian(x, u[run], t)
            Q_dot = F @ Q + Q @ F.T + model.Q_s
            return np.concatenate([model.f(x, u[run], t), (F @ Phi).ravel(), Q_dot.ravel()])

        start = np.concatenate([mean[run], np.eye(2).ravel(), np.zeros(4)])
        end = solve_ivp(rates, (0, dt), start, "DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
        x, Phi, Q = end[:2], end[2:6].reshape(2, 2), end[6:].reshape(2, 2)
        P = Phi @ cov[run] @ Phi.T + Q
        np.testing.assert_allclose(belief.mean[run], x, atol=1e-9)
        np.testing.assert_allclose(belief.cov[run], P, atol=1e-9)
        H = np.array([[2.0 * x[0], 1.0]])
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + model.R)
        np.testing.assert_allclose(
            posterior.mean[run], x + K @ (y[run] - model.h(x, 0, 0)), atol=1e-8
        )
        np.testing.assert_allclose(posterior.cov[run], (np.eye(2) - K @ H) @ P, atol=1e-8)


def test_equals_the_ekf_on_the_same_model():
    model = van_der_pol(substeps=2)
    rng = np.random.default_rng(0)
    mean, cov = rng.standard_normal((4, 2)), random_cov(rng, 2, 4)
    ours, theirs = ContinuousDiscreteEKF(model, substeps=2), EKF(model)
    a, b = ours.init(mean, cov), theirs.init(mean, cov)
    for k in range(10):
        u, y = rng.standard_normal((4, 1)), rng.standard_normal((4, 1))
        a, _ = ours.update(ours.predict(a, u, 0.1 * k, 0.1), y, u, 0.1 * (k + 1))
        b, _ = theirs.update(theirs.predict(b, u, 0.1 * k, 0.1), y, u, 0.1 * (k + 1))
    np.testing.assert_allclose(a.mean, b.mean, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(a.cov, b.cov, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_converges_to_the_discrete_ekf_of_a_linear_model_with_order_four(seed):
    """The exact discretization, Φ and Q by Van Loan, run by the discrete EKF."""
    rng = np.random.default_rng(seed)
    F, C = rng.standard_normal((3, 3)), rng.standard_normal((2, 3))
    Q_s, R, dt = random_cov(rng, 3), random_cov(rng, 2), 0.2
    continuous = ContinuousFunctionModel(
        lambda x, u, t: x @ F.T, lambda x, u, t: x @ C.T, Q_s, R,
        f_jacobian=lambda x, u, t: F, h_jacobian=lambda x, u, t: C,
    )  # fmt: skip
    Phi, Q = van_loan(F, Q_s, dt)
    exact = EKF(LinearModel(Phi, C, Q, R))
    mean, cov = rng.standard_normal((2, 3)), random_cov(rng, 3, 2)
    u, ys = np.zeros((2, 0)), rng.standard_normal((5, 2, 2))

    def drive(estimator):
        belief = estimator.init(mean, cov)
        for k, y in enumerate(ys):
            belief = estimator.predict(belief, u, dt * k, dt)
            belief, _ = estimator.update(belief, y, u, dt * (k + 1))
        return np.concatenate([belief.mean.ravel(), belief.cov.ravel()])

    reference = drive(exact)
    errors = [
        np.abs(drive(ContinuousDiscreteEKF(continuous, substeps=s)) - reference).max()
        for s in (2, 4, 8, 16)
    ]
    rate = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert errors[-1] < 1e-6
    assert rate[-1] > 3.7
    adaptive = ContinuousDiscreteEKF(continuous, method="rk45", rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(drive(adaptive), reference, atol=1e-8)


@pytest.mark.parametrize("seed", range(2))
def test_converges_with_order_four_on_a_curved_state(seed):
    model: Any = Tumbling()
    x, u, dt = state(seed, 2), np.zeros((2, 0)), 0.8
    fine = integrate_moments(model, x, u, 0.0, dt, 200)
    errors = []
    for substeps in (4, 8, 16):
        mean, Phi, Q = integrate_moments(model, x, u, 0.0, dt, substeps)
        pairs = (model.space.minus(mean, fine[0]), Phi - fine[1], Q - fine[2])
        errors.append([np.abs(e).max() for e in pairs])
    rate = np.log2(np.array(errors)[:-1] / np.array(errors)[1:])
    assert (rate[-1] > 3.5).all()


@pytest.mark.parametrize("seed", range(2))
def test_phi_is_the_derivative_of_the_motion_on_a_curved_state(seed):
    model: Any = Tumbling()
    x, u = state(seed, 3), np.zeros((3, 0))
    mean, Phi, _ = integrate_moments(model, x, u, 0.0, 0.5, 40)
    end, slope = Differences("centered", 1e-5).jacobian(
        lambda p: integrate(model, p, u, 0.0, 0.5, 40), model.space, model.space, x
    )
    np.testing.assert_allclose(mean, end, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(Phi, slope, atol=1e-6)


def test_process_noise_is_the_sum_of_what_is_added_in_short_steps_on_a_curved_state():
    model: Any = Tumbling()
    x, u, steps = state(3, 1), np.zeros((1, 0)), 200
    _, _, Q = integrate_moments(model, x, u, 0.0, 0.5, 40)
    total, point = np.zeros((1, 6, 6)), x
    for _ in range(steps):
        point, Phi, _ = integrate_moments(model, point, u, 0.0, 0.5 / steps)
        added = 0.25 / steps * model.spectral_density(point, u, 0.0)
        total = Phi @ (total + added) @ np.swapaxes(Phi, 1, 2) + added
    np.testing.assert_allclose(Q, total, atol=1e-5)


def test_rk4_and_rk45_agree_on_a_curved_state():
    model: Any = Tumbling()
    x, u = state(4, 3), np.zeros((3, 0))
    cov = 0.1 * random_cov(np.random.default_rng(4), 6, 3)
    fixed = ContinuousDiscreteEKF(model, substeps=100)
    adaptive = ContinuousDiscreteEKF(model, method="rk45", rtol=1e-10, atol=1e-12)
    a, b = (e.predict(e.init(x, cov), u, 0.0, 0.5) for e in (fixed, adaptive))
    np.testing.assert_allclose(a.mean, b.mean, atol=1e-8)
    np.testing.assert_allclose(a.cov, b.cov, atol=1e-7)


@pytest.mark.parametrize("method", ["rk4", "rk45"])
def test_a_run_that_blows_up_is_marked_and_leaves_the_others_alone(method):
    """ẋ = x² from x₀ = 1/0.05 escapes at t = 0.05."""
    model = ContinuousFunctionModel(
        lambda x, u, t: x**2, lambda x, u, t: x, 0.01 * np.eye(1), np.eye(1)
    )
    mean = np.array([[0.1], [20.0], [-0.3], [np.nan], [0.2]])
    cov, u = np.ones((5, 1, 1)), np.zeros((5, 0))
    estimator = ContinuousDiscreteEKF(model, method=method, substeps=30)
    with np.errstate(invalid="ignore", over="ignore"):  # as the event loop does
        belief = estimator.predict(estimator.init(mean, cov), u, 0.0, 0.1)
    np.testing.assert_array_equal(belief.fault, [0, Fault.STATE, 0, Fault.STATE, 0])
    good = [0, 2, 4]
    np.testing.assert_allclose(belief.mean[good], mean[good] / (1 - 0.1 * mean[good]), atol=1e-8)


def test_rk45_holds_its_tolerance_in_every_run_of_a_batch():
    """One fast run among many that hardly move."""
    model = van_der_pol()
    mean = np.zeros((300, 2))
    mean[7] = [2.0, -3.0]
    u, cov = np.zeros((300, 1)), np.broadcast_to(np.eye(2), (300, 2, 2))
    estimator = ContinuousDiscreteEKF(model, method="rk45", rtol=1e-6, atol=1e-6)
    together = estimator.predict(estimator.init(mean, cov), u, 0.0, 1.0)
    exact = integrate(model, mean[7:8], u[7:8], 0.0, 1.0, 2000)
    np.testing.assert_allclose(together.mean[7], exact[0], atol=1e-5)


@pytest.mark.parametrize("cls", [EKF, UKF, KF, LKF, SquareRootEKF])
def test_every_filter_runs_on_a_continuous_model(cls):
    model = van_der_pol()
    rng = np.random.default_rng(5)
    mean, cov = 0.1 * rng.standard_normal((3, 2)), 0.1 * random_cov(rng, 2, 3)
    estimator, u = cls(model), np.zeros((3, 1))
    belief = estimator.init(mean, cov)
    truth = mean
    for k in range(20):
        truth = model.transition(truth, u, 0.1 * k, 0.1)
        belief = estimator.predict(belief, u, 0.1 * k, 0.1)
        belief, _ = estimator.update(belief, model.measurement(truth, u), u, 0.1 * (k + 1))
    assert not belief.fault.any()
    assert np.abs(estimator.mean(belief) - truth).max() < 0.5


def test_a_discrete_model_is_refused_in_one_line():
    with pytest.raises(EstimatorError, match="LinearModel has no method 'flow'") as caught:
        ContinuousDiscreteEKF(linear_model(0))  # pyright: ignore[reportArgumentType]
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "settings",
    [
        {"method": "euler"},
        {"substeps": 0},
        {"substeps": 1.5},
        {"rtol": 0.0},
        {"atol": 0.0},
        {"covariance_update": "no"},
    ],
)
def test_wrong_settings_are_refused(settings):
    (name,) = settings
    with pytest.raises(EstimatorError, match=f"ContinuousDiscreteEKF: {name} is"):
        ContinuousDiscreteEKF(van_der_pol(), **settings)
