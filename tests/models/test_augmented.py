import numpy as np
import pytest

from estbench.errors import ScenarioError
from estbench.models.augmented import Augmented, Bias
from estbench.models.differences import Differences
from estbench.models.protocol import Model
from tests.helpers import CENTERED, linear_model, mujoco_model, nonlinear_model, random_states

SENSORS = (Bias("y0", 0.3, walk=0.1), Bias("y1", 0.2, time_constant=2.0))


def numeric(function, source, target, x):
    """Centered differences, one perturbation at a time."""
    columns = []
    for e in 1e-6 * np.eye(source.n):
        up, down = (function(source.plus(x, s * e)) for s in (1, -1))
        base = function(x)
        columns.append((target.minus(up, base) - target.minus(down, base)) / 2e-6)
    return np.stack(columns, axis=-1)


def test_augmented_is_a_model_with_named_states():
    model = Augmented(nonlinear_model(4), SENSORS, (Bias("u0", 0.5),))
    assert isinstance(model, Model)
    assert model.space.names[4:] == ("bias.y0", "bias.y1", "input.u0")
    assert model.space.n == model.space.nx == 7


def test_equations_of_the_augmented_model():
    inner = linear_model(1)
    assert inner.B is not None
    assert inner.D is not None
    model = Augmented(inner, SENSORS, (Bias("u0", 0.5, walk=0.3),))
    rng = np.random.default_rng(0)
    x, u, dt = rng.standard_normal((4, 6)), rng.standard_normal((4, 1)), 0.5
    decay = np.array([1.0, np.exp(-dt / 2.0), 1.0])
    v = u + x[:, 5:]
    expected = np.concatenate([x[:, :3] @ inner.A.T + v @ inner.B.T, x[:, 3:] * decay], axis=-1)
    np.testing.assert_allclose(model.transition(x, u, 0, dt), expected, atol=1e-12)
    y = x[:, :3] @ inner.C.T + v @ inner.D.T + x[:, 3:5]
    np.testing.assert_allclose(model.measurement(x, u, 0), y, atol=1e-12)
    Q = np.zeros((6, 6))
    Q[:3, :3] = inner.Q
    Q[range(3, 6), range(3, 6)] = [0.01 * dt, 0.04 * (1 - np.exp(-dt)), 0.09 * dt]
    np.testing.assert_allclose(model.process_noise(x, u, 0, dt), Q, atol=1e-12)
    mean, cov = model.augment(x[:, :3], np.tile(np.eye(3), (4, 1, 1)))
    np.testing.assert_array_equal(mean, np.concatenate([x[:, :3], np.zeros((4, 3))], axis=-1))
    np.testing.assert_allclose(cov[2], np.diag([1, 1, 1, 0.09, 0.04, 0.25]))


def test_an_unknown_input_may_be_a_gauss_markov_process():
    """d⁺ = e^(-dt/τ) d ⊞ w, w ~ N(0, σ² (1 - e^(-2 dt/τ))): its variance stays σ²."""
    model = Augmented.build(nonlinear_model(4), inputs=0.5, input_time_constant=0.2)
    x, u, dt = np.ones((2, 5)), np.zeros((2, 1)), 0.1
    assert model.space.names[-1] == "input.u0"
    assert model.transition(x, u, 0.0, dt)[:, -1] == pytest.approx(np.exp(-0.5))
    variance = model.process_noise(x, u, 0.0, dt)[..., -1, -1]
    assert variance == pytest.approx(0.25 * (1 - np.exp(-1.0)))
    with pytest.raises(ScenarioError, match="both walk and time_constant"):
        Augmented.build(nonlinear_model(4), inputs=0.5, input_walk=0.1, input_time_constant=0.2)


def test_points_are_the_runs_one_by_one():
    model = Augmented(nonlinear_model(4), SENSORS, (Bias("u0", 0.5),))
    rng = np.random.default_rng(1)
    points, u = rng.standard_normal((3, 5, 7)), rng.standard_normal((3, 1))
    moved, read = model.transition(points, u, 0.0, 0.1), model.measurement(points, u, 0.0)
    for i in range(5):
        np.testing.assert_allclose(moved[:, i], model.transition(points[:, i], u, 0.0, 0.1))
        np.testing.assert_allclose(read[:, i], model.measurement(points[:, i], u, 0.0))


@pytest.mark.parametrize("inputs", [(), (Bias("u0", 0.5),)])
def test_jacobians_equal_differences(inputs):
    model = Augmented(nonlinear_model(4), SENSORS, inputs)
    rng = np.random.default_rng(2)
    x, u = 0.5 * rng.standard_normal((3, model.space.nx)), rng.standard_normal((3, 1))
    value, F = model.transition_jacobian(x, u, 0.0, 0.1)
    np.testing.assert_allclose(value, model.transition(x, u, 0.0, 0.1))
    expected = numeric(lambda p: model.transition(p, u, 0.0, 0.1), model.space, model.space, x)
    np.testing.assert_allclose(F, expected, atol=1e-7)
    value, H = model.measurement_jacobian(x, u, 0.0)
    np.testing.assert_allclose(value, model.measurement(x, u, 0.0))
    expected = numeric(lambda p: model.measurement(p, u, 0.0), model.space, model.output(), x)
    np.testing.assert_allclose(H, expected, atol=1e-7)


def test_quaternion_states_biases_and_channels():
    inner = mujoco_model("joints", differences=CENTERED)
    model = Augmented.build(
        inner,
        bias={"wrist_quat*": 0.1, "gyro.y": 0.2, "lift*": 0.3},
        inputs={"u1": 0.5},
        walk={"gyro*": 0.01},
    )
    assert model.space.names[inner.space.n :] == (
        "bias.lift_encoder", "bias.wrist_quat.x", "bias.wrist_quat.y", "bias.wrist_quat.z",
        "bias.gyro.y", "input.u1",
    )  # fmt: skip
    assert model.space.units[-6:] == ("m", "rad", "rad", "rad", "rad/s", "1")
    assert [b.walk for b in model.biases] == [0, 0, 0, 0, 0.01, 0]
    x, u = random_states(inner.mjmodel, 3)
    rng = np.random.default_rng(3)
    x = np.concatenate([x, 0.4 * rng.standard_normal((3, 6))], axis=-1)
    assert model.space.nx == x.shape[-1]
    _, F = model.transition_jacobian(x, u, 0.0, 0.008)
    expected = numeric(lambda p: model.transition(p, u, 0.0, 0.008), model.space, model.space, x)
    np.testing.assert_allclose(F, expected, atol=1e-6)
    for channels in (None, ("gyro", "wrist_quat"), ("attitude",)):
        output = model.output(channels)
        y, H = model.measurement_jacobian(x, u, 0.0, channels)
        np.testing.assert_allclose(y, model.measurement(x, u, 0.0, channels), atol=1e-12)
        expected = numeric(
            lambda p, c=channels: model.measurement(p, u, 0.0, c), model.space, output, x
        )
        np.testing.assert_allclose(H, expected, atol=1e-6)
    quaternion = model.measurement(x, u, 0.0, ("wrist_quat",))
    np.testing.assert_allclose(np.linalg.norm(quaternion, axis=-1), 1.0)


def test_failed_rows_stay_failed():
    model = Augmented(nonlinear_model(4), SENSORS, (Bias("u0", 0.5),), Differences())
    x, u = np.zeros((3, 7)), np.zeros((3, 1))
    x[1] = np.nan
    moved, F = model.transition_jacobian(x, u, 0.0, 0.1)
    assert np.isnan(moved[1]).all()
    assert np.isfinite(moved[[0, 2]]).all()
    assert np.isfinite(F[[0, 2]]).all()


@pytest.mark.parametrize(
    ("sensors", "inputs", "words"),
    [
        ((Bias("y9", 1.0),), (), "bias of y9: no such name"),
        ((), (Bias("u3", 1.0),), "bias of u3: no such name"),
        ((Bias("y0", 1.0), Bias("y0", 2.0)), (), "bias of y0 is given twice"),
    ],
)
def test_wrong_targets_say_so(sensors, inputs, words):
    with pytest.raises(ScenarioError, match=words):
        Augmented(linear_model(0), sensors, inputs)


def test_wrong_biases_say_so():
    with pytest.raises(ScenarioError, match="bias of y0: std is -1"):
        Bias("y0", -1)
    with pytest.raises(ScenarioError, match="both walk and time_constant"):
        Bias("y0", 1, walk=1, time_constant=2)
    with pytest.raises(ScenarioError, match="matches none"):
        Augmented.build(linear_model(0), bias={"gyro*": 0.1})
