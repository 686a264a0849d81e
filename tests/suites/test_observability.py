"""What is seen agrees with the rank of the observability matrix, and with symbolic results."""

import numpy as np
import pytest

import estbench
from estbench.bounds.expectation import Reading
from estbench.bounds.linearization import Linearization
from estbench.errors import ScenarioError
from estbench.models.function import FunctionModel
from estbench.models.linear import LinearModel
from estbench.suites.along import Motion
from estbench.suites.gramian import gathered, left
from estbench.suites.observability import of_motion
from estbench.suites.words import echelon, said
from tests.helpers import random_cov


def motion(model, x0, std, u, steps=30, dt=0.1):
    """The motion of a model without noise, all channels at every step."""
    x = [np.asarray(x0, float)[None]]
    u = np.broadcast_to(np.asarray(u, float), (steps, 1, model.nu))
    for k in range(steps):
        x.append(model.transition(x[-1], u[k], k * dt, dt))
    times = dt * np.arange(steps + 1)
    read = [Reading(k, k) for k in range(1, steps + 1)]
    space, root = model.space, np.diag(np.broadcast_to(np.asarray(std, float), len(x0)))
    return Motion(Linearization(model), space.names, space.units, root, times, np.stack(x), u, read)


@pytest.mark.parametrize("hidden", [0, 1, 2])
def test_the_rank_is_that_of_the_observability_matrix(hidden):
    """Modes that the sensor does not read, in rotated coordinates, with a full P₀."""
    rng, n = np.random.default_rng(hidden), 5
    A = np.diag(rng.uniform(0.7, 1.05, n))
    C = rng.standard_normal((2, n))
    C[:, :hidden] = 0.0
    T = np.linalg.qr(rng.standard_normal((n, n)))[0]
    model = LinearModel(T @ A @ T.T, C @ T.T, 0.1 * np.eye(n), np.eye(2))
    matrix = np.concatenate([model.C @ np.linalg.matrix_power(model.A, k) for k in range(1, n + 1)])
    rank = np.linalg.matrix_rank(matrix)
    assert rank == n - hidden
    root = np.linalg.cholesky(random_cov(rng, n))
    plain = motion(model, np.zeros(n), 1.0, np.zeros(0))
    given = Motion(**{**vars(plain), "root": root})
    *_, last = gathered(given)
    values, vectors = np.linalg.eigh(last[0])
    assert (values > 1e-9 * values[-1]).sum() == rank
    np.testing.assert_allclose(matrix @ root @ vectors[:, :hidden], 0.0, atol=1e-6)
    info = np.zeros((n, n))  # the posterior is that of least squares
    for k in range(1, 31):
        H = model.C @ np.linalg.matrix_power(model.A, k)
        info += H.T @ H
    prior = root @ root.T
    posterior = np.linalg.inv(np.linalg.inv(prior) + info)
    expected = np.sqrt(np.diag(posterior) / np.diag(prior))
    np.testing.assert_allclose(left(last[0], root), expected, rtol=1e-8)


def unicycle():
    """x = (x, y, heading), u = (speed, rate), the range to a beacon at the origin."""

    def f(x, u, t, dt):
        heading = x[..., 2:]
        ahead = np.concatenate([np.cos(heading), np.sin(heading)], axis=-1) * u[..., :1]
        return x + dt * np.concatenate([ahead, u[..., 1:]], axis=-1)

    def h(x, u, t):
        return np.linalg.norm(x[..., :2], axis=-1, keepdims=True)

    return FunctionModel(
        f, h, 1e-6 * np.eye(3), [[1e-4]], n_controls=2, names=("x", "y", "heading")
    )


def test_unicycle_with_the_range_to_a_beacon():
    """A turn about the beacon, (-y, x, 1), changes no range (Martinelli & Siegwart 2005)."""
    x0 = np.array([2.0, 1.0, 0.3])
    *_, info = gathered(motion(unicycle(), x0, 1.0, [1.0, 0.4]))
    turn = np.array([-x0[1], x0[0], 1.0])
    values, vectors = np.linalg.eigh(info[0])
    assert values[0] < 1e-6 < 1.0 < values[1]
    np.testing.assert_allclose(np.abs(vectors[:, 0] @ turn) / np.linalg.norm(turn), 1.0, rtol=1e-6)
    found = of_motion("unicycle", motion(unicycle(), x0, 1.0, [1.0, 0.4]))
    assert [d.text for d in found.never] == ["-0.5 x + y + 0.5 heading"]
    straight = of_motion("straight", motion(unicycle(), [2.0, 0.0, 0.0], 1.0, [1.0, 0.0]))
    assert {d.text for d in straight.never} == {"y", "heading"}  # it only comes nearer


def test_when_each_direction_becomes_seen():
    """A position sensor and a slow drift: the position at once, the velocity when it has moved."""
    A = np.array([[1.0, 0.1], [0.0, 1.0]])
    C, R = np.array([[1.0, 0.0]]), np.array([[0.25]])
    model = LinearModel(A, C, 1e-9 * np.eye(2), R, names=("p", "v"))
    found = of_motion("drift", motion(model, [0.0, 0.0], [1.0, 0.1], np.zeros(0), steps=400))
    assert not found.never
    assert found.seen_from[0] == pytest.approx(0.1)
    assert 1.0 < found.seen_from[1] < 10.0
    texts = {d.text: d.seen_from for d in found.directions}
    assert texts["v"] > 1.0


def test_imu_and_position_leave_the_heading_at_rest():
    sensors = 'sensors=["accel","gyro","position"]'
    found = estbench.observability("quadrotor", window=0.4, overrides=[sensors], motions=False)
    texts = [d.text for d in found.never]
    assert "root.rz" in texts
    assert found.left[found.names.index("root.rz")] > 0.99
    assert found.left[found.names.index("root.z")] < 0.5
    nowhere = estbench.observability(
        "quadrotor",
        window=0.2,
        overrides=['sensors=["gyro","attitude"]', "channels.gyro.bias=0.02"],
    )
    texts = {d.text: d for d in nowhere.never}
    assert {"root.x", "root.y", "root.z", "root.vx"} < texts.keys()
    assert texts["root.x"].left == pytest.approx(1.0)
    assert "bias.gyro.x" in nowhere.names


def test_a_quadruped_does_not_see_its_heading():
    """The noise of a run is no known force, whose direction in the world would show the heading."""
    shaken = 'process_noise.density={"root.v?"=1.0}'
    found = estbench.observability("quadruped", window=0.02, overrides=[shaken], motions=False)
    left_of = dict(zip(found.names, found.left))
    assert min(left_of["root.x"], left_of["root.y"], left_of["root.rz"]) > 0.99
    assert max(left_of["root.z"], left_of["root.rx"]) < 0.5


def test_a_motion_that_shows_what_is_hidden():
    """The acrobot without the encoder of the elbow: a bent elbow moves the shoulder more."""
    overrides = ['sensors=["shoulder_encoder"]']
    found = estbench.observability("acrobot", window=1.0, overrides=overrides)
    (hidden,) = found.never
    assert "elbow.vel" in hidden.text
    name, kept = hidden.shown_by[0]
    assert name == "a start with elbow = 0.5 rad"
    assert kept < 0.7 < hidden.left


def test_coordinates_that_are_known_at_the_start():
    known = 'initial.std={"hinge"=0.1}'
    found = estbench.observability("pendulum", window=0.3, overrides=[known], motions=False)
    assert np.isnan(found.left[1])
    assert found.left[0] < 0.2
    assert len(found.eigenvalues) == 1


def test_directions_in_words():
    names = ("a", "b", "c", "d")
    rotated = np.linalg.qr(np.random.default_rng(0).standard_normal((2, 2)))[0]
    basis = np.array([[1.0, 0.0], [0.0, 0.6], [0.0, -0.8], [0.0, 0.0]]) @ rotated
    found = echelon(basis)
    np.testing.assert_allclose(np.abs(found.T @ found), np.eye(2), atol=1e-12)
    assert [said(v, names) for v in found.T] == ["a", "-0.75 b + c"]
    assert said(np.array([1.0, 1.0, 0.1, 0.0]), names) == "a + b"
    assert said(np.ones(7), "abcdefg") == "a, b, c, d, e and 2 more together"


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["initial.std=0.0"], "there is nothing to observe"),
        (["channels.gyro.noise=0.0", "filter.channels.gyro.noise=0.1"], "gyro without white noise"),
    ],
)
def test_bad_input(overrides, message):
    with pytest.raises(ScenarioError, match=message):
        estbench.observability("pendulum", window=0.1, overrides=overrides)
