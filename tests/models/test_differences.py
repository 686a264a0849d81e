import numpy as np
import pytest

from estbench.errors import ScenarioError
from estbench.models.differences import Differences
from estbench.robots.layout import state_space
from estbench.spaces.manifold import Manifold
from tests.helpers import mujoco_model, random_states, zoo_model

LINE = Manifold.euclidean(2)


def cubic(x):
    return np.stack([x[..., 0] ** 3, x[..., 0] * x[..., 1], np.sin(x[..., 1])], axis=-1)


@pytest.mark.parametrize(
    ("scheme", "step", "tolerance"), [("forward", 1e-6, 1e-5), ("centered", 1e-5, 1e-9)]
)
def test_value_and_jacobian(scheme, step, tolerance):
    x = np.array([[0.5, -0.3], [1.0, 2.0]])
    value, J = Differences(scheme, step).jacobian(cubic, LINE, Manifold.euclidean(3), x)
    np.testing.assert_array_equal(value, cubic(x))
    for i, (a, b) in enumerate(x):
        expected = [[3 * a**2, 0], [b, a], [0, np.cos(b)]]
        np.testing.assert_allclose(J[i], expected, atol=tolerance)


def test_the_order_of_the_error():
    # d(x³) at 1: forward errs by 3 step + step², centered by step².
    for scheme, error in (("forward", 3e-2 + 1e-4), ("centered", 1e-4)):
        _, J = Differences(scheme, 1e-2).jacobian(
            cubic, LINE, Manifold.euclidean(3), np.ones((1, 2))
        )
        assert J[0, 0, 0] - 3 == pytest.approx(error, rel=1e-9)


@pytest.mark.parametrize(("scheme", "rows"), [("forward", 3), ("centered", 5)])
def test_one_call_with_the_expected_count_of_points(scheme, rows):
    shapes = []

    def function(x):
        shapes.append(x.shape)
        return x

    Differences(scheme).jacobian(function, LINE, LINE, np.zeros((4, 2)))
    assert shapes == [(4, rows, 2)]


@pytest.mark.parametrize("scheme", ["forward", "centered"])
def test_in_the_tangent_of_a_curved_space(scheme):
    # x -> x ⊞ a turns the tangent by the inverse of a's rotation; the identity has the identity.
    model = zoo_model("joints")
    space = state_space(model)
    x, _ = random_states(model, 3, scale=1.0)
    differences = Differences(scheme, 1e-6)
    _, J = differences.jacobian(lambda p: p, space, space, x)
    np.testing.assert_allclose(J, np.broadcast_to(np.eye(space.n), J.shape), atol=1e-9)
    a = 0.7 * np.random.default_rng(0).standard_normal(space.n)
    _, J = differences.jacobian(lambda p: space.plus(p, a), space, space, x)
    block = J[0][np.ix_(*[range(2, 5)] * 2)]  # the ball joint
    np.testing.assert_allclose(block @ block.T, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(block @ a[2:5], a[2:5], atol=1e-6)
    other = np.array([0.1, -0.2, 0.3])
    turned = other - np.cross(1e-4 * a[2:5], other)  # exp(-a) acts as 1 - a× for a small a
    _, J = differences.jacobian(lambda p: space.plus(p, 1e-4 * a), space, space, x)
    np.testing.assert_allclose(J[0][np.ix_(*[range(2, 5)] * 2)] @ other, turned, atol=1e-7)


def test_a_nan_run_leaves_the_others_alone():
    x = np.array([[0.5, -0.3], [np.nan, 0.0], [1.0, 2.0]])
    _, J = Differences().jacobian(cubic, LINE, Manifold.euclidean(3), x)
    _, alone = Differences().jacobian(cubic, LINE, Manifold.euclidean(3), x[[0, 2]])
    np.testing.assert_array_equal(J[[0, 2]], alone)


@pytest.mark.parametrize("step", [0.0, -1e-6, 1.0, float("nan")])
def test_step_out_of_range(step):
    with pytest.raises(ScenarioError, match=r"difference step is .*; use a value in \(0, 1\)"):
        Differences("forward", step)


def test_unknown_scheme():
    with pytest.raises(ScenarioError, match="scheme is 'backward'; use 'forward' or 'centered'"):
        Differences("backward")


@pytest.mark.parametrize(("scheme", "step"), [("forward", 1e-6), ("centered", 1e-5)])
@pytest.mark.parametrize("x0", [1.0, -4.6e6, 1.7e9, 1e12])
def test_large_coordinates(x0, scheme, step):
    # A drifting position, a velocity with drag, and a beacon that is 100 away.
    def transition(p):
        speed = p[..., 1]
        return np.stack([p[..., 0] + 0.1 * speed, speed - 0.01 * speed**2], axis=-1)

    def bearing(p):
        east, north = p[..., 0] - (x0 - 60.0), p[..., 1] + 77.0
        return np.stack([np.hypot(east, north), np.arctan2(north, east)], axis=-1)

    x, differences = np.array([[x0, 3.0]]), Differences(scheme, step)
    _, F = differences.jacobian(transition, LINE, LINE, x)
    np.testing.assert_allclose(F[0], [[1, 0.1], [0, 0.94]], rtol=0, atol=1e-7)
    _, H = differences.jacobian(bearing, LINE, Manifold.euclidean(2, angles=[1]), x)
    expected = np.array([[0.6, 0.8], [-0.008, 0.006]])
    # With rounding errors e and curvature c no step of a forward difference errs by less than
    # 2 sqrt(e c); e is 1e-4 at 1e12, c = 0.8²/100.
    least = 2 * np.sqrt(4 * np.finfo(float).eps * abs(x0) * 0.0064)
    np.testing.assert_allclose(H[0], expected, rtol=0, atol=1e-7 + 2 * least)


def test_small_coordinates_are_as_before_beside_a_large_one():
    x = np.array([[0.5, -0.3], [4.6e6, 1.0], [np.nan, 1.0], [1.0, 2.0]])
    with np.errstate(invalid="ignore"):
        _, J = Differences().jacobian(cubic, LINE, Manifold.euclidean(3), x)
    _, alone = Differences().jacobian(cubic, LINE, Manifold.euclidean(3), x[[0, 3]])
    np.testing.assert_array_equal(J[[0, 3]], alone)
    np.testing.assert_allclose(J[1, 0, 0], 3 * 4.6e6**2, rtol=1e-5)
    assert np.isnan(J[2, 0, 0])


@pytest.mark.parametrize("x0", [4.6e6, 1e9])
def test_a_robot_far_from_the_origin(x0):
    mjcf_model = zoo_model("free")
    model = mujoco_model("free")
    x, u = random_states(mjcf_model, 2)
    far = x.copy()
    far[:, 0] += x0
    _, near = model.transition_jacobian(x, u, 0.0, 0.05)
    _, there = model.transition_jacobian(far, u, 0.0, 0.05)
    np.testing.assert_allclose(there, near, rtol=0, atol=3e-13 * x0 + 1e-5)
