import numpy as np
import pytest

from estbench.errors import CovarianceError, DimensionError
from estbench.models.continuous import ContinuousFunctionModel
from estbench.models.linear import LinearModel
from estbench.spaces.covariance import check_covariance

GOOD = np.array([[4.0, 1.0], [1.0, 9.0]])


@pytest.mark.parametrize(
    "cov",
    [GOOD, np.zeros((2, 2)), np.diag([1.0, 0.0]), np.ones((2, 2)), 1e-300 * GOOD, 1e200 * GOOD,
     np.diag([1e-18, 1e6]), np.stack([GOOD, np.ones((2, 2))]), np.zeros((0, 2, 2)),
     np.outer([1e-8, 1e3], [1e-8, 1e3]), np.add(GOOD, [[0, 1e-12], [0, 0]])],
)  # fmt: skip
def test_covariances_pass(cov):
    check_covariance("Q", cov)


@pytest.mark.parametrize(
    ("cov", "message"),
    [
        (
            -0.5 * np.eye(2),
            "Q is not symmetric positive semidefinite: .* eigenvalue is -0.5; raise",
        ),
        (np.array([[1.0, 0.5], [0.0, 1.0]]), r"entry \[0, 1\] is 0.5 and \[1, 0\] is 0"),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), "eigenvalue is -1"),
        (np.diag([1.0, np.nan]), r"entry \[1, 1\] is nan"),
        (np.diag([np.inf, 1.0]), r"entry \[0, 0\] is inf"),
        (np.stack([GOOD, -GOOD, GOOD]), "Q of run 1 is not"),
        # Hidden behind a large coordinate, or by small units:
        (np.diag([1e6, -1e-9]), "eigenvalue is -1e-09"),
        (-1e-13 * np.eye(2), "eigenvalue is -1e-13"),
        (np.array([[1e6, 0, 0], [0, 1e-9, 2e-9], [0, 2e-9, 1e-9]]), "eigenvalue is -1e-09"),
        (np.array([[1.0, 0.5], [0.5, 0.0]]), "eigenvalue is -0.207"),
    ],
)
def test_others_are_named(cov, message):
    with pytest.raises(CovarianceError, match=message):
        check_covariance("Q", cov)


def test_definite():
    check_covariance("R", GOOD, definite=True)
    with pytest.raises(CovarianceError, match=r"R is not symmetric positive definite at t = 2: "):
        check_covariance("R", np.ones((2, 2)), definite=True, when=" at t = 2")


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"Q": np.array([[-0.5]])}, CovarianceError, "^Q is not .* -0.5"),
        ({"Q": np.array([[np.nan]])}, CovarianceError, "^Q is not"),
        ({"Q": np.array([[0.1 + 0j]])}, DimensionError, "^Q is ndarray of complex128"),
        ({"Q": np.ma.masked_all((1, 1))}, DimensionError, "^Q is a masked array"),
        ({"R": np.array([[0.0]])}, CovarianceError, "^R is not .* definite"),
        ({"Q": 0.1}, DimensionError, r"^Q has shape \(\); expected a matrix"),
        ({"A": np.array([[np.inf]])}, DimensionError, "^A has an entry that is not finite"),
        ({"Q": np.stack([np.eye(1), -np.eye(1)])}, CovarianceError, "^Q of run 1 is not"),
    ],
)
def test_a_linear_model_checks_its_matrices(changes, error, message):
    one = np.eye(1)
    with pytest.raises(error, match=message):
        LinearModel(**({"A": one, "C": one, "Q": one, "R": one} | changes))


def test_a_continuous_model_checks_its_density():
    def model(Q_s):
        return ContinuousFunctionModel(
            lambda x, u, t: -x, lambda x, u, t: x, Q_s, np.eye(1), n_controls=0
        )

    with pytest.raises(CovarianceError, match=r"^Q_s is not symmetric positive semidefinite: "):
        model(-np.eye(1))
    later = model(lambda t: np.eye(1) * (1 - t))
    with pytest.raises(CovarianceError, match=r"^Q_s is not .* at t = 2: "):
        later.spectral_density(np.zeros((1, 1)), np.zeros((1, 0)), 2.0)
