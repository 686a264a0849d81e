"""The filters of IMU and leg kinematics against textbooks, differences and known motions."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import scipy.stats

from estbench.errors import EstimatorError
from estbench.estimators import registry
from estbench.estimators.contact_ekf import ContactEKF
from estbench.estimators.contact_inekf import ContactInEKF
from estbench.estimators.foot_readings import joint_filter, joint_step
from estbench.estimators.standing_feet import rolling, slipping
from estbench.models.seen_noise import SeenNoise
from estbench.spaces import rotation
from tests.helpers import nonlinear_model, random_cov
from tests.legged import NOISE, robot, xml

BOTH = pytest.mark.parametrize("kind", [ContactEKF, ContactInEKF])
DT, G = 0.01, np.array([0.0, 0.0, -9.81])
BIASED = {"gyro_bias": 0.02, "accelerometer_bias": 0.2, "gyro_walk": 0.01, "foot_noise": 0.03}
HALF = np.sqrt(0.5)
TURNED = "0.05 -0.02 0.1", f"{HALF} 0 0 {HALF}"


@pytest.fixture(scope="module")
def hover():
    return robot(xml(), density={"root.v?": 0.01})


def started(estimator, runs=2, seed=0, scale=0.3):
    """A belief far from zero, with every covariance."""
    model, rng = estimator.model, np.random.default_rng(seed)
    rest = np.concatenate([model.mjmodel.qpos0, np.zeros(model.mjmodel.nv)])
    x = model.space.plus(rest, scale * rng.standard_normal((runs, model.space.n)))
    belief = estimator.init(x, random_cov(rng, model.space.n, runs, 0.01))
    imu = np.concatenate([rng.standard_normal((runs, 3)), 5 * rng.standard_normal((runs, 3))], 1)
    mean = belief.mean.copy()
    mean[:, -6:] = 0.1 * rng.standard_normal((runs, 6))
    imu_cov = np.diag([NOISE["gyro"] ** 2] * 3 + [NOISE["accelerometer"] ** 2] * 3)
    cov = random_cov(rng, estimator.n, runs, 0.01)
    return replace(
        belief, mean=mean, cov=cov, imu=imu, imu_cov=np.repeat(imu_cov[None], runs, axis=0),
        standing=np.ones(belief.standing.shape, bool), age=np.ones(belief.age.shape),
    )  # fmt: skip


def reading(imu, joints, touch):
    return np.concatenate([imu, joints, touch], axis=1)


def plain(belief, m, by):
    """The difference of two states in plain coordinates (φ, δv, δp, δd, δb)."""
    turn = rotation.multiply(rotation.conjugate(m[:, :4]), by[:, :4])
    return np.concatenate([rotation.log(turn), by[:, 4:] - m[:, 4:]], axis=1)


def moved(m, delta):
    """The reverse of `plain`."""
    turned = rotation.multiply(m[:, :4], rotation.exp(delta[:, :3]))
    return np.concatenate([turned, m[:, 4:] + delta[:, 3:]], axis=1)


@BOTH
def test_propagation_against_differences(kind, hover):
    """P⁻ = F P Fᵀ + G R Gᵀ + Q with F and G by differences of the motion itself."""
    estimator = kind(hover, **BIASED)
    belief = started(estimator)
    u, eps = np.zeros((2, 0)), 1e-6
    ahead = estimator.predict(belief, u, 0.0, DT)

    def end(delta=None, imu=None):
        start = belief if delta is None else replace(belief, mean=moved(belief.mean, delta))
        start = start if imu is None else replace(start, imu=start.imu + imu)
        return estimator.predict(start, u, 0.0, DT).mean

    F, G_imu = np.empty((2, estimator.n, estimator.n)), np.empty((2, estimator.n, 6))
    for j, step in enumerate(eps * np.eye(estimator.n)):
        ends = [end(delta=np.repeat(sign * step[None], 2, axis=0)) for sign in (1, -1)]
        F[:, :, j] = (plain(belief, ahead.mean, ends[0]) - plain(belief, ahead.mean, ends[1])) / 2
    for j, step in enumerate(eps * np.eye(6)):
        ends = [end(imu=np.repeat(sign * step[None], 2, axis=0)) for sign in (1, -1)]
        difference = plain(belief, ahead.mean, ends[0]) - plain(belief, ahead.mean, ends[1])
        G_imu[:, :, j] = difference / 2
    F, G_imu = F / eps, G_imu / eps
    expected = (
        F @ estimator._plain(belief.mean, belief.cov) @ F.mT + G_imu @ belief.imu_cov @ G_imu.mT
    )
    unfelt = np.zeros(estimator.n)
    unfelt[3:6] = 0.01 * DT  # the scenario's noise on the velocity
    unfelt[9:15], unfelt[15:18] = 0.03**2 * DT, 0.01**2 * DT
    where = np.arange(estimator.n)
    expected[:, where, where] += unfelt
    got = estimator._plain(ahead.mean, ahead.cov)
    np.testing.assert_allclose(got, expected, atol=1e-8)


def test_the_invariant_error_propagates_independently_of_the_estimate(hover):
    """Group-affine: X₁ = Exp(ξ) X₂ stays so with ξ⁺ = F ξ, whatever X₂, for a ξ of any size."""
    estimator = ContactInEKF(hover)
    rng = np.random.default_rng(3)
    xi = np.concatenate([0.8 * rng.standard_normal((2, estimator.n - 6)), np.zeros((2, 6))], 1)
    Fs = []
    for seed in (1, 2):
        second = started(estimator, seed=seed, scale=1.0)
        second = replace(second, imu=started(estimator, seed=9).imu)
        first = estimator._plus(second, xi, second.cov)
        u = np.zeros((2, 0))
        ends = [estimator.predict(b, u, 0.0, DT) for b in (first, second)]
        rate, force = second.imu[:, :3], second.imu[:, 3:]
        F = estimator._transition(second.mean, ends[1].mean, rate, force, DT)
        after = np.concatenate([(F @ xi[..., None])[:, :-6, 0], np.zeros((2, 6))], axis=1)
        same = replace(second, mean=np.concatenate([ends[1].mean[:, :-6], second.mean[:, -6:]], 1))
        expected = estimator._plus(same, after, second.cov).mean
        turn = rotation.multiply(rotation.conjugate(expected[:, :4]), ends[0].mean[:, :4])
        np.testing.assert_allclose(rotation.log(turn), 0.0, atol=1e-12)
        np.testing.assert_allclose(ends[0].mean[:, 4:-6], expected[:, 4:-6], atol=1e-12)
        Fs.append(F[:, :-6, :-6])
    np.testing.assert_array_equal(Fs[0], Fs[1])
    bent = ContactEKF(hover)
    parts = [
        bent._transition(m.mean, m.mean, m.imu[:, :3], m.imu[:, 3:], DT)[:, :-6, :-6]
        for m in (started(bent, seed=1), started(bent, seed=2))
    ]
    assert np.abs(parts[0] - parts[1]).max() > 1e-3


def test_the_update_of_the_invariant_filter_is_that_of_its_matrices(hover):
    """X̂⁺ = exp([K ν]) X̂ in SE_4(3), ν from Y = X⁻¹ b as in Hartley et al. 2020, eq. 19-23."""
    estimator = ContactInEKF(hover, slip_gate=1)
    prior = started(estimator, runs=1)
    rng = np.random.default_rng(4)
    q = 0.1 * rng.standard_normal((1, 6))
    y = reading(prior.imu, q, np.full((1, 2), 99.0))
    post, innovation = estimator.update(prior, y, np.zeros((1, 0)), DT)
    m, s, N = prior.mean[0], hover.legs.feet(q)[0][0], 2
    R = scipy.spatial.transform.Rotation.from_quat(m[:4], scalar_first=True).as_matrix()
    X = np.eye(5 + N)
    X[:3, :3] = R
    X[:3, 3:] = m[4:16].reshape(4, 3).T
    nu, H = [], np.zeros((6, estimator.n))
    for i in range(N):
        b = np.zeros(5 + N)
        b[4], b[5 + i] = 1.0, -1.0
        Y = np.concatenate([s[i], b[3:]])
        nu.append((X @ Y)[:3])
        H[3 * i : 3 * i + 3, 6:9] = -np.eye(3)
        H[3 * i : 3 * i + 3, 9 + 3 * i : 12 + 3 * i] = np.eye(3)
    nu, P = np.concatenate(nu), prior.cov[0]
    noise = scipy.linalg.block_diag(*[NOISE["encoder"] ** 2 * R @ R.T] * N)
    S = H @ P @ H.T + noise
    K = np.linalg.solve(S, H @ P).T
    xi = K @ nu
    wedge = np.zeros((5 + N, 5 + N))
    wedge[:3, :3] = rotation.skew(xi[:3])
    wedge[:3, 3:] = xi[3:15].reshape(4, 3).T
    after = scipy.linalg.expm(wedge) @ X
    got = post.mean[0]
    np.testing.assert_allclose(rotation.matrix(got[:4]), after[:3, :3], atol=1e-10)
    np.testing.assert_allclose(got[4:16].reshape(4, 3).T, after[:3, 3:], atol=1e-10)
    np.testing.assert_allclose(got[16:], m[16:] + xi[15:], atol=1e-10)
    np.testing.assert_allclose(post.cov[0], P - K @ H @ P, atol=1e-10)
    np.testing.assert_allclose(innovation.nis[0], nu @ np.linalg.solve(S, nu), rtol=1e-10)
    assert innovation.dof[0] == 6


def test_the_update_of_the_error_state_filter_is_a_kalman_filter(hover):
    """H by differences of Rᵀ (d - p), Joseph's form, and the reset of the rotation's tangent."""
    estimator = ContactEKF(hover, slip_gate=1, **BIASED)
    prior = started(estimator, runs=1)
    q = 0.05 * np.random.default_rng(5).standard_normal((1, 6))
    y = reading(prior.imu, q, np.full((1, 2), 99.0))
    post, innovation = estimator.update(prior, y, np.zeros((1, 0)), DT)

    def seen(m):
        reach = m[:, 10:16].reshape(-1, 2, 3) - m[:, None, 7:10]
        return (reach @ rotation.matrix(m[:, :4])).reshape(-1, 6)

    eps = 1e-5
    steps = eps * np.eye(estimator.n)
    ends = [seen(moved(prior.mean.repeat(len(steps), axis=0), sign * steps)) for sign in (1, -1)]
    H = ((ends[0] - ends[1]) / (2 * eps)).T
    P, R = prior.cov[0], NOISE["encoder"] ** 2 * np.eye(6)
    nu = hover.legs.feet(q)[0].reshape(6) - seen(prior.mean)[0]
    S = H @ P @ H.T + R
    K = np.linalg.solve(S, H @ P).T
    A = np.eye(estimator.n) - K @ H
    delta = K @ nu
    reset = np.eye(estimator.n)
    reset[:3, :3] = rotation.right_jacobian(delta[:3])
    cov = reset @ (A @ P @ A.T + K @ R @ K.T) @ reset.T
    np.testing.assert_allclose(post.mean, moved(prior.mean, delta[None]), atol=1e-8)
    np.testing.assert_allclose(post.cov[0], cov, atol=1e-8)
    np.testing.assert_allclose(innovation.nis[0], nu @ np.linalg.solve(S, nu), rtol=1e-7)
    # The innovation has the shape of the measurement; the feet are in the places of the encoders.
    np.testing.assert_allclose(innovation.residual[0, 6:12], nu, atol=1e-10)
    np.testing.assert_allclose(innovation.cov[0, 6:12, 6:12], S, atol=1e-8)
    assert not innovation.residual[0, :6].any()
    assert not innovation.residual[0, 12:].any()


def test_both_are_the_kalman_filter_where_the_attitude_is_known(hover):
    """With R exact and no bias the feet, p and v are a linear system."""
    filters = [kind(hover, foot_noise=0.02, slip_gate=1) for kind in (ContactEKF, ContactInEKF)]
    rng = np.random.default_rng(6)
    x = np.concatenate([hover.mjmodel.qpos0, np.zeros(hover.mjmodel.nv)])[None]
    P0 = np.diag(np.where(np.char.find(hover.space.names, "root.r") >= 0, 0.0, 0.01))[None]
    beliefs = [f.init(x, P0) for f in filters]
    quiet = np.zeros((1, 6, 6))
    quiet[:, 3:, 3:] = 0.1**2 * np.eye(3)
    F = np.eye(15)
    F[6:9, 3:6] = DT * np.eye(3)
    m, P = beliefs[0].mean[0, 4:16], beliefs[0].cov[0, 3:15, 3:15]
    F, H = F[3:, 3:], np.hstack([np.zeros((6, 3)), -np.vstack([np.eye(3)] * 2), np.eye(6)])
    B = np.vstack([DT * np.eye(3), 0.5 * DT**2 * np.eye(3), np.zeros((6, 3))])
    Q = np.diag([0.01 * DT] * 3 + [0.0] * 3 + [0.02**2 * DT] * 6)
    for _ in range(5):
        force = -G + rng.standard_normal(3)
        q = 0.01 * rng.standard_normal((1, 6))
        y = reading(np.concatenate([np.zeros(3), force])[None], q, np.full((1, 2), 99.0))
        for i, f in enumerate(filters):
            b = replace(
                beliefs[i],
                imu=y[:, :6],
                imu_cov=quiet,
                standing=np.ones((1, 2), bool),
                age=np.ones((1, 2)),
            )
            b = f.predict(b, np.zeros((1, 0)), 0.0, DT)
            beliefs[i], _ = f.update(b, y, np.zeros((1, 0)), DT)
        m, P = F @ m + B @ (force + G), F @ P @ F.T + Q + B @ B.T * 0.1**2
        nu = hover.legs.feet(q)[0].reshape(6) - H @ m
        K = np.linalg.solve(H @ P @ H.T + NOISE["encoder"] ** 2 * np.eye(6), H @ P).T
        m, P = m + K @ nu, P - K @ H @ P
    for b in beliefs:
        np.testing.assert_allclose(b.mean[0, 4:16], m, atol=1e-10)
        np.testing.assert_allclose(b.cov[0, 3:15, 3:15], P, atol=1e-10)


def motion(steps, bias, turn=0.4, rise=0.5, radius=0.0):
    """A base that turns and rises over two feet that roll; states, and noise-free readings."""
    rest = np.array([[0.2, 0.1, -0.4], [-0.2, -0.1, -0.4]])
    place = rest
    rate, q, p, v = np.array([0.1, -0.2, turn]), np.array([1.0, 0, 0, 0]), np.zeros(3), np.zeros(3)
    R_i, at, y = [], [], []
    for k in range(steps + 1):
        R = rotation.matrix(q)
        force = np.array([0.3, -0.2, rise]) * np.cos(k * DT * 6.0)
        joints = (place - p) @ R - rest
        specific = R.T @ (force - G)
        at.append(np.concatenate([p, q, joints.ravel(), v, rate, np.zeros(6)]))
        y.append(np.concatenate([rate + bias[:3], specific + bias[3:], joints.ravel(), [9.0, 9.0]]))
        R_i.append(R)
        p = p + v * DT + 0.5 * force * DT**2
        v = v + force * DT
        q = rotation.multiply(q, rotation.exp(rate * DT))
        place = place + radius * np.array([rate[1], -rate[0], 0.0]) * DT  # r ω x e_z
    return np.array(at), np.array(y)


@BOTH
def test_without_noise_it_is_exact_and_finds_velocity_attitude_and_biases(kind, hover):
    """Roll, pitch, velocity and biases are found from the feet; position and yaw are not."""
    bias = np.array([0.01, -0.02, 0.0, 0.0, 0.0, 0.1])
    x, y = motion(400, bias)
    space, u = hover.space, np.zeros((2, 0))
    std = np.full(space.n, 1e-3)
    std[:6], std[12:15] = 0.05, 0.2
    off = np.zeros(space.n)
    off[:6], off[12:15] = [0.05, -0.05, 0.02, 0.05, -0.04, 0.03], [0.2, -0.2, 0.1]
    start = np.stack([x[0], space.plus(x[0], off)])
    settings = {"foot_noise": 1e-4, "gyro_bias": 0.02, "accelerometer_bias": 0.1, "threshold": 5.0}
    estimator = kind(robot(xml()), **settings)
    belief = estimator.init(start, np.repeat(np.diag(std**2)[None], 2, axis=0))
    exact = belief.mean.copy()
    exact[0, -6:] = bias
    belief = replace(belief, mean=exact)
    belief, _ = estimator.update(belief, np.repeat(y[:1], 2, axis=0), u, 0.0)
    for k in range(1, len(x)):
        belief = estimator.predict(belief, u, 0.0, DT)
        belief, _ = estimator.update(belief, np.repeat(y[k : k + 1], 2, axis=0), u, k * DT)
    error = space.minus(x[-1], estimator.mean(belief))
    # Joint velocities are smoothed readings, not exact; of the base everything is.
    np.testing.assert_allclose(error[0, :6], 0.0, atol=1e-8)
    np.testing.assert_allclose(error[0, 12:18], 0.0, atol=1e-8)
    lost = space.minus(x[-1], estimator.mean(belief))[1]
    turn = rotation.matrix(x[-1, 3:7]) @ lost[3:6]  # in the world: tilt, tilt, yaw
    assert np.abs(turn[:2]).max() < 2e-3
    assert np.abs(lost[12:15]).max() < 5e-3
    assert np.linalg.norm(lost[:3]) > 0.02
    np.testing.assert_allclose(turn[2], -0.03, atol=2e-3)  # as at the start
    found = np.array([estimate[1] for estimate, _ in estimator.biases(belief).values()])
    np.testing.assert_allclose(found[[0, 1, 5]], bias[[0, 1, 5]], atol=5e-3)
    P = np.sqrt(np.diagonal(estimator.cov(belief), axis1=-2, axis2=-1))[1]
    assert (np.abs(lost[[0, 1, 2, 3, 4, 5, 12, 13, 14]])
            < 4 * P[[0, 1, 2, 3, 4, 5, 12, 13, 14]]).all()  # fmt: skip


@BOTH
def test_feet_that_roll(kind):
    """Spheres of 50 mm that turn with the base: exact, and a point that stands is 0.1 m off."""
    x, y = motion(50, np.zeros(6), radius=0.05)
    u, errors = np.zeros((1, 0)), []
    for radius in (0.05, None):
        model = robot(xml(radius=radius))
        estimator = kind(model, threshold=5.0, slip_gate=1.0)
        belief = estimator.init(x[:1], 1e-4 * np.eye(model.space.n)[None])
        for k, reading in enumerate(y):
            belief = estimator.predict(belief, u, k * DT, DT) if k else belief
            belief, _ = estimator.update(belief, reading[None], u, k * DT)
        errors.append(model.space.minus(x[-1:], estimator.mean(belief))[0, np.r_[0:6, 12:18]])
    np.testing.assert_allclose(errors[0], 0.0, atol=1e-8)
    assert np.abs(errors[1]).max() > 1e-3


def test_the_velocity_of_a_foot_that_rolls():
    """A wheel of radius r, turned by 90°: r w along its way, half of w from a joint."""
    R = rotation.matrix(np.array([[HALF, 0.0, 0.0, HALF]]))
    turns = np.zeros((1, 2, 3, 2))
    turns[0, :, 1, 0], turns[0, 1, 0, 1] = 1.0, 1.0
    up, radii = np.array([0.0, 0.0, 1.0]), np.array([0.2, 0.1])
    found = rolling(np.array([[0.0, 1.5, 9.0]]), turns, np.array([[1.5, 0.5]]), R, radii, up)
    np.testing.assert_allclose(found[0], [[0.0, 0.6, 0.0], [0.05, 0.3, 0.0]], atol=1e-12)
    still = rolling(np.ones((1, 3)), turns, np.ones((1, 2)), R, np.zeros(2), up)
    np.testing.assert_array_equal(still, np.zeros((1, 2, 3)))


def test_the_gate_is_that_of_a_foot_alone():
    rng = np.random.default_rng(2)
    residual, S = rng.standard_normal((20, 6)), random_cov(rng, 6, 20, 0.3)
    for gate in (0.5, 0.9):
        found = slipping(residual, S, gate)
        for foot in (0, 1):
            own = np.r_[3 * foot : 3 * foot + 3]
            nis = [nu[own] @ np.linalg.solve(C[own[:, None], own], nu[own])
                   for nu, C in zip(residual, S)]  # fmt: skip
            expected = np.array(nis) > scipy.stats.chi2.ppf(gate, 3)
            assert 0 < expected.sum() < 20
            np.testing.assert_array_equal(found[:, foot], expected)
    assert not slipping(residual, S, 1.0).any()


@BOTH
def test_a_foot_that_slips_or_has_just_come_down_is_where_the_joints_are(kind, hover):
    x, y = motion(8, np.zeros(6))
    estimator, u = kind(hover, threshold=5.0, settle=3 * DT), np.zeros((2, 0))
    belief = estimator.init(np.repeat(x[:1], 2, 0), 1e-4 * np.eye(hover.space.n)[None].repeat(2, 0))
    y = np.repeat(y[:, None], 2, axis=1)
    y[:3, 1, 13] = 0.0  # the second foot of the second run comes down at the fourth reading
    y[6:, 0, 6] += 0.05  # the first foot of the first run slips by 50 mm
    dof = []
    for k, reading in enumerate(y):
        belief = estimator.predict(belief, u, k * DT, DT) if k else belief
        belief, innovation = estimator.update(belief, reading, u, k * DT)
        dof.append(innovation.dof.tolist())
    assert dof == [[0, 0]] * 3 + [[6, 3]] * 3 + [[3, 6], [6, 6], [6, 6]]
    error = hover.space.minus(np.repeat(x[-1:], 2, 0), estimator.mean(belief))
    assert np.abs(error[:, np.r_[:6, 12:15]]).max() < 1e-2
    s, *_ = hover.legs.feet(y[-1, :1, 6:12])
    world = belief.mean[0, 7:10] + s[0, 0] @ rotation.matrix(belief.mean[0, :4]).T
    np.testing.assert_allclose(belief.mean[0, 10:13], world, atol=1e-3)


@BOTH
def test_what_it_says_of_the_state_with_the_imu_anywhere_in_the_base(kind):
    """init then mean and cov give the prior of the base back; the joints are independent of it."""
    model = robot(xml(*TURNED))
    estimator, rng = kind(model), np.random.default_rng(7)
    n, base = model.space.n, np.r_[0:6, 12:18]
    rest = np.concatenate([model.mjmodel.qpos0, np.zeros(model.mjmodel.nv)])
    x = model.space.plus(rest, 0.5 * rng.standard_normal((3, n)))
    P = random_cov(rng, n, 3, 0.01)
    belief = estimator.init(x, P)
    np.testing.assert_allclose(model.space.minus(estimator.mean(belief), x), 0.0, atol=1e-12)
    out = estimator.cov(belief)
    kept = np.r_[0:6, 12:15]  # the rate is a reading of its own from the start on
    np.testing.assert_allclose(np.diagonal(out, 0, 1, 2), np.diagonal(P, 0, 1, 2), rtol=0.5)
    np.testing.assert_allclose(out[:, kept[:6, None], kept[:6]], P[:, kept[:6, None], kept[:6]],
                               atol=1e-12)  # fmt: skip
    np.testing.assert_allclose(out[:, 15:18, 15:18], P[:, 15:18, 15:18], atol=1e-12)
    assert not out[:, base[:, None], np.r_[6:12, 18:24]].any()


@BOTH
def test_a_lifted_foot_says_nothing_and_a_reading_that_is_lost_takes_nothing_away(kind, hover):
    estimator, u = kind(hover, slip_gate=1), np.zeros((4, 0))
    belief = started(estimator, runs=4)
    belief = estimator.predict(belief, u, 0.0, DT)
    rng = np.random.default_rng(8)
    q = 0.1 * rng.standard_normal((4, 6))
    y = reading(rng.standard_normal((4, 6)), q, np.full((4, 2), 99.0))
    y[1, -2:] = 0.0  # both feet in the air
    mask = np.ones(y.shape, bool)
    mask[2, 6:9] = False  # one leg's encoders are lost
    mask[3] = False
    post, innovation = estimator.update(belief, y, u, DT, None, mask)
    assert innovation.dof.tolist() == [6, 0, 3, 0]
    np.testing.assert_array_equal(post.mean[3], belief.mean[3])
    np.testing.assert_allclose(post.cov[3], belief.cov[3], atol=1e-15)
    np.testing.assert_array_equal(post.mean[1, :10], belief.mean[1, :10])
    # Feet in the air are where the joints are; the covariance says so.
    s, *_ = hover.legs.feet(q)
    world = belief.mean[1, 7:10] + s[1] @ rotation.matrix(belief.mean[1, :4]).T
    np.testing.assert_allclose(post.mean[1, 10:16].reshape(2, 3), world, atol=1e-12)
    P = estimator._plain(post.mean, post.cov)[1]
    J = np.zeros((3, estimator.n))
    R = rotation.matrix(post.mean[1, :4])
    J[:, 6:9], J[:, :3] = np.eye(3), -R @ rotation.skew(s[1, 0])
    J[:, 9:12] = -np.eye(3)
    np.testing.assert_allclose(J @ P @ J.T, NOISE["encoder"] ** 2 * np.eye(3), atol=1e-12)
    assert post.standing.tolist() == [[True, True], [False, False], [True, True], [True, True]]
    # A foot that comes down again starts anew: it is not measured at its first reading.
    y[1, -2:] = 99.0
    again, second = estimator.update(post, y, u, DT)
    assert second.dof.tolist() == [6, 0, 6, 6]
    assert again.standing.all()


def test_the_joints_filter_is_a_kalman_filter_of_two_states():
    rng = np.random.default_rng(9)
    joints, (a, b, c) = rng.standard_normal((1, 2, 1)), (0.3, 0.1, 0.5)
    cov, angle, r, accel = np.array([[[a], [b], [c]]]), np.array([[0.7]]), 0.2, 3.0
    F = np.array([[1.0, DT], [0.0, 1.0]])
    Q = accel**2 * np.array([[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]])
    m, P = F @ joints[0, :, 0], F @ [[a, b], [b, c]] @ F.T + Q
    K = P[:, 0] / (P[0, 0] + r)
    m, P = m + K * (0.7 - m[0]), P - np.outer(K, P[0])
    moved, grown = joint_step(joints, cov, accel, DT)
    mean, after = joint_filter(moved, grown, angle, np.array([r]), np.ones((1, 1), bool))
    np.testing.assert_allclose(mean[0, :, 0], m, atol=1e-14)
    np.testing.assert_allclose(after[0, :, 0], [P[0, 0], P[0, 1], P[1, 1]], atol=1e-14)
    same = joint_filter(moved, grown, angle, np.array([r]), np.zeros((1, 1), bool))
    np.testing.assert_array_equal(same[0], moved)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"foot_noise": -1.0}, "ContactEKF: foot_noise is -1.0; use a number in"),
        ({"threshold": -1.0}, "ContactEKF: threshold is -1.0; use a number in"),
        ({"settle": -0.1}, "ContactEKF: settle is -0.1; use a number in"),
        ({"slip_gate": 1.5}, r"ContactEKF: slip_gate is 1.5; use a number in \(0, 1\]"),
        ({"gyro_walk": "much"}, "ContactEKF: gyro_walk is 'much'; use"),
    ],
)
def test_bad_settings(settings, message, hover):
    with pytest.raises(EstimatorError, match=message):
        registry.create("contact_ekf", settings, hover)


def test_models_that_it_cannot_use(hover):
    with pytest.raises(EstimatorError, match="ContactInEKF: the model has no legs; use ekf"):
        registry.create("contact_inekf", {}, nonlinear_model(2))
    short = xml().replace('<joint name="b_z" type="slide" axis="0 0 1"/>', "")
    short = short.replace('<jointpos name="b_z_encoder" joint="b_z"/>', "")
    with pytest.raises(EstimatorError, match="2 joints of its own move the foot of b_touch"):
        registry.create("contact_ekf", {}, robot(short))
    blind = xml().replace('<jointpos name="b_z_encoder" joint="b_z"/>', "")
    with pytest.raises(EstimatorError, match=r"ContactEKF: no encoder on b_z; add .*; or use ekf"):
        registry.create("contact_ekf", {}, robot(blind))
    with pytest.raises(EstimatorError, match="sensors see the disturbance of the last interval"):
        registry.create("contact_ekf", {}, SeenNoise(robot(xml(), 0.01, "force")))


@BOTH
def test_a_run_does_not_depend_on_its_batch(kind, hover):
    """To the bit, also where a foot is put down in another run only."""
    estimator, u = kind(hover, **BIASED), np.zeros((3, 0))
    belief = started(estimator, runs=3)
    y = reading(belief.imu, np.full((3, 6), 0.01), np.full((3, 2), 99.0))
    y[1, -1] = 0.0
    alone = [
        replace(belief, **{k: v[i : i + 1] for k, v in vars(belief).items()}) for i in range(3)
    ]
    for k in range(3):
        belief, _ = estimator.update(estimator.predict(belief, u, k * DT, DT), y, u, k * DT + DT)
        for i in range(3):
            ahead = estimator.predict(alone[i], u[:1], k * DT, DT)
            alone[i], _ = estimator.update(ahead, y[i : i + 1], u[:1], k * DT + DT)
    for i in range(3):
        np.testing.assert_array_equal(alone[i].mean[0], belief.mean[i])
        np.testing.assert_array_equal(alone[i].cov[0], belief.cov[i])
