import numpy as np
import pytest

from estbench.errors import ScenarioError
from estbench.models.differences import Differences
from estbench.robots.layout import state_space
from estbench.spaces.manifold import Manifold
from tests.helpers import random_states, zoo_model

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
