import numpy as np
import pytest

from estbench.errors import CovarianceError, DimensionError
from estbench.models.linear import LinearModel
from estbench.models.protocol import Model
from tests.helpers import linear_model, random_cov

CASES = [(0, 1, 1, 1), (1, 3, 2, 1), (2, 5, 1, 3), (3, 2, 4, 2)]


@pytest.mark.parametrize("case", CASES)
def test_equations(case):
    model = linear_model(*case)
    rng = np.random.default_rng(1)
    x, u = rng.standard_normal((4, case[1])), rng.standard_normal((4, case[3]))
    f, F = model.transition_jacobian(x, u)
    y, H = model.measurement_jacobian(x, u)
    for i in range(4):
        np.testing.assert_allclose(f[i], model.A @ x[i] + model.B @ u[i], atol=1e-12)
        np.testing.assert_allclose(y[i], model.C @ x[i] + model.D @ u[i], atol=1e-12)
        np.testing.assert_array_equal(F[i], model.A)
        np.testing.assert_array_equal(H[i], model.C)
    np.testing.assert_array_equal(model.transition(x, u), f)
    np.testing.assert_array_equal(model.measurement(x, u), y)
    assert model.process_noise(x, u) is model.Q
    assert model.measurement_noise() is model.R
    assert isinstance(model, Model)
    assert (model.nu, model.space.n, model.output().n) == (case[3], case[1], case[2])


def test_many_points_share_their_runs_control():
    model, rng = linear_model(4), np.random.default_rng(0)
    points, u = rng.standard_normal((2, 5, 3)), rng.standard_normal((2, 1))
    for j in range(5):
        for method in (model.transition, model.measurement):
            np.testing.assert_allclose(method(points, u)[:, j], method(points[:, j], u), atol=1e-13)


def test_one_matrix_a_run():
    a, b = linear_model(5), linear_model(6)
    names = ("A", "C", "Q", "R", "B", "D")
    both = LinearModel(*(np.stack([getattr(a, k), getattr(b, k)]) for k in names))
    rng = np.random.default_rng(0)
    x, u = rng.standard_normal((2, 3)), rng.standard_normal((2, 1))
    for i, model in enumerate((a, b)):
        row = slice(i, i + 1)
        for method in ("transition_jacobian", "measurement_jacobian"):
            values = getattr(both, method)(x, u)
            for value, alone in zip(values, getattr(model, method)(x[row], u[row])):
                np.testing.assert_allclose(value[i], alone[0], atol=1e-13)
        np.testing.assert_array_equal(both.process_noise(x, u)[i], model.Q)


def test_no_controls_by_default():
    rng = np.random.default_rng(0)
    model = LinearModel(np.eye(2), np.ones((1, 2)), np.eye(2), np.eye(1), names=("a", "b"))
    x = rng.standard_normal((3, 2))
    assert model.nu == 0
    assert model.space.names == ("a", "b")
    np.testing.assert_array_equal(model.transition(x, np.zeros((3, 0))), x)
    np.testing.assert_allclose(model.measurement(x, np.zeros((3, 0)))[:, 0], x.sum(axis=1))


GOOD = {
    "A": np.eye(2),
    "C": np.ones((1, 2)),
    "Q": np.eye(2),
    "R": np.eye(1),
    "B": np.ones((2, 3)),
}


@pytest.mark.parametrize(
    ("name", "shape", "expected"),
    [
        ("A", (3, 2), (2, 2)),
        ("C", (1, 3), (1, 2)),
        ("Q", (1, 1), (2, 2)),
        ("R", (2, 2), (1, 1)),
        ("B", (3, 3), (2, 3)),
        ("D", (1, 2), (1, 3)),
    ],
)
def test_a_matrix_of_another_shape_is_named(name, shape, expected):
    with pytest.raises(DimensionError) as error:
        LinearModel(**(GOOD | {name: np.ones(shape)}))
    assert str(error.value) == f"{name} has shape {shape}; expected {expected}"


@pytest.mark.parametrize("name", ["A", "C", "Q", "R"])
def test_a_matrix_that_is_needed_may_not_be_none(name):
    with pytest.raises(DimensionError, match=f"{name} is NoneType of object; expected float64"):
        LinearModel(**(GOOD | {name: None}))


@pytest.mark.parametrize(
    "R",
    [np.diag([1.0, 0.0]), np.diag([1.0, -1.0]), np.array([[1, 0.5], [0, 1]]), [[np.nan] * 2] * 2],
)
def test_R_must_be_positive_definite(R):
    with pytest.raises(CovarianceError, match="R is not symmetric positive definite"):
        LinearModel(np.eye(2), np.eye(2), np.eye(2), np.asarray(R))


def test_a_correlated_R_is_fine():
    R = random_cov(np.random.default_rng(0), 2)
    assert LinearModel(np.eye(2), np.eye(2), np.zeros((2, 2)), R).R is R
