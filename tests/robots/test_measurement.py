import copy

import numpy as np
import pytest

from estbench.errors import ScenarioError
from estbench.robots import backend, layout
from estbench.robots.disturbance import Disturbance
from estbench.robots.library import engine
from estbench.robots.measurement import Measurand, Plan
from estbench.robots.model import MujocoModel, SensorChannel
from estbench.spaces.manifold import Manifold, product
from tests.helpers import random_states, zoo_model


def speed_and_height(x, u, t):
    return np.stack([x[..., -1] + u[..., 0], x[..., 2] ** 2 + t], axis=-1)


def sources(model):
    """The attitude, a function, and two sensors together."""
    index = {layout.sensor_name(model, i): i for i in range(model.nsensor)}
    space = Manifold(("f.0", "f.1"), ("m/s", "m"))
    return [
        Measurand.of_sensors(model, index["attitude"]),
        Measurand(space, function=speed_and_height, name="f"),
        Measurand.of_sensors(model, index["gyro"], index["lift_encoder"]),
    ]


@pytest.mark.parametrize("points", [None, 5])
def test_a_plan_reads_sensors_and_functions_in_order(points):
    model = zoo_model("joints")
    x, u = random_states(model, 3 if points is None else 3 * points)
    if points is not None:
        x, u = x.reshape(3, points, -1), u[:3]
    parts, rows = sources(model), backend.create(model)
    with engine():
        together = Plan(model, parts).read(rows, x, u, 0.5)
        one_by_one = [Plan(model, [s]).read(rows, x, u, 0.5) for s in parts]
    np.testing.assert_array_equal(together, np.concatenate(one_by_one, axis=-1))
    assert together.shape == (*x.shape[:-1], 4 + 2 + 4)
    np.testing.assert_array_equal(one_by_one[1][..., 1], x[..., 2] ** 2 + 0.5)
    spread = u if points is None else u[:, None]
    np.testing.assert_array_equal(one_by_one[1][..., 0], x[..., -1] + spread[..., 0])


def test_the_space_of_a_plan_is_that_of_its_parts():
    model = zoo_model("joints")
    space = Plan(model, sources(model)).space
    assert (space.n, space.nx) == (9, 10)
    assert space.names[:5] == ("attitude.x", "attitude.y", "attitude.z", "f.0", "f.1")
    assert space.units[3:] == ("m/s", "m", "rad/s", "rad/s", "rad/s", "m")
    np.testing.assert_array_equal(space.quaternions, [[0, 0]])


def test_only_functions():
    model = zoo_model("joints")
    x, u = random_states(model, 2)
    space = Manifold(("a", "b"), ("1", "1"))
    plan = Plan(model, [Measurand(space, function=speed_and_height, name="f")])
    np.testing.assert_array_equal(
        plan.read(backend.create(model), x, u, 0.0), speed_and_height(x, u, 0.0)
    )


def test_a_product_of_manifolds():
    turn = Manifold(("rx", "ry", "rz"), ("rad",) * 3, np.array([[0, 0]]))
    line = Manifold(("z",), ("m",))
    both = product([line, turn, turn])
    np.testing.assert_array_equal(both.quaternions, [[1, 1], [5, 4]])
    assert both.names == ("z", "rx", "ry", "rz", "rx", "ry", "rz")
    assert product([]).n == 0
    rng = np.random.default_rng(0)
    x = both.plus(np.array([[0.0, 1, 0, 0, 0, 1, 0, 0, 0]]), rng.standard_normal((4, 7)))
    delta = 0.1 * rng.standard_normal((4, 7))
    moved = [
        s.plus(x[:, a:b], delta[:, c:d])
        for s, a, b, c, d in ((line, 0, 1, 0, 1), (turn, 1, 5, 1, 4), (turn, 5, 9, 4, 7))
    ]
    np.testing.assert_array_equal(both.plus(x, delta), np.concatenate(moved, axis=-1))


def model_with_a_function():
    mj = zoo_model("joints")
    space = layout.state_space(mj)
    channels = [
        SensorChannel(f"c{i}", -1, np.diag(np.arange(1.0, s.space.n + 1)), None, s)
        for i, s in enumerate(sources(mj))
    ]
    return MujocoModel(mj, channels, Disturbance.build(mj, space, "additive", 0.1))


def test_the_filters_jacobian_of_a_function_of_the_state():
    model = model_with_a_function()
    x, u = random_states(model.mjmodel, 3)
    with engine():
        y, H = model.measurement_jacobian(x, u, 0.3, ["c1"])
    expected = np.zeros((3, 2, model.space.n))
    expected[:, 0, -1] = 1.0
    expected[:, 1, 2] = 2 * x[:, 2]
    jump = model.space.n - model.space.nx  # quaternions before: none before qpos[2]
    assert jump < 0
    np.testing.assert_allclose(y, speed_and_height(x, u, 0.3))
    rows = np.linalg.norm(H, axis=-1)
    np.testing.assert_allclose(H[:, 0], expected[:, 0], atol=1e-5)
    assert (rows > 0).all()
    assert model.measurement_noise(0.0).shape == (9, 9)
    np.testing.assert_array_equal(model.measurement_noise(0.0, ["c2"]), np.diag([1.0, 2, 3, 4]))


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda x, u, t: x[0, :2], r"f returned shape \(2,\) for x of shape \(3, \d+\); expected"),
        (lambda x, u, t: x[:, :3], r"expected \(3, 2\): index the state as x\[\.\.\., i\]"),
        (
            lambda x, u, t: x[9],
            r"f raised for x of shape \(3.*: IndexError: .* \(test_measurement\.py:",
        ),
    ],
)
def test_a_function_that_does_not_fit(function, message):
    model = zoo_model("joints")
    x, u = random_states(model, 3)
    source = Measurand(Manifold(("a", "b"), ("1", "1")), function=function, name="f")
    with pytest.raises(ScenarioError, match=message):
        source.call(x, u, 0.0)


def test_a_function_cannot_change_the_state():
    def harm(x, u, t):
        x[..., 0] = 9.0
        return x[..., :1]

    model = zoo_model("joints")
    x, u = random_states(model, 2)
    before = x.copy()
    Measurand(Manifold(("a",), ("1",)), function=harm, name="f").call(x, u, 0.0)
    np.testing.assert_array_equal(x, before)


def test_encoders_and_tachometers_need_no_engine():
    model = zoo_model("joints")
    encoder = Plan(model, [Measurand.of_sensors(model, 0)])
    assert encoder.known is not None
    assert encoder.reach == model.nv
    np.testing.assert_array_equal(encoder.known[0], [0])
    np.testing.assert_array_equal(encoder.known[1], np.eye(2 * model.nv + model.na)[:1])
    assert Plan(model, sources(model)[:1]).known is None
    clipped = copy.copy(model)  # the model itself is shared by other tests
    clipped.sensor_cutoff[0] = 0.5  # a clipped reading is not the coordinate
    assert Plan(clipped, [Measurand.of_sensors(clipped, 0)]).known is None


def test_what_a_sensor_can_see_of_the_state():
    model = zoo_model("joints")
    attitude, function, imu = sources(model)
    assert Plan(model, [attitude]).reach == model.nv
    assert Plan(model, [imu]).reach == 2 * model.nv
    assert Plan(model, [attitude, function]).reach == 2 * model.nv + model.na
