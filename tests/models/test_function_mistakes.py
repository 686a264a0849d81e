"""Whatever a user's function does wrong ends in one sentence that names it, in every estimator."""

import numpy as np
import pytest

from estbench.errors import CovarianceError, DimensionError, ModelError
from estbench.estimators.ekf import EKF
from estbench.estimators.ukf import UKF
from estbench.models.continuous import ContinuousFunctionModel
from estbench.models.function import FunctionModel

RUNS, N = 3, 2


def model(**wrong):
    def identity(x, u, *time):
        return x

    return FunctionModel(**{"f": identity, "h": identity, "Q": np.eye(N), "R": np.eye(N), **wrong})


def use(estimator):
    """One step of an estimator: the posterior mean `(run, n)`."""
    belief = estimator.init(np.full((RUNS, N), 0.1), np.tile(np.eye(N), (RUNS, 1, 1)))
    u = np.zeros((RUNS, 0))
    belief = estimator.predict(belief, u, 1.0, 0.1)
    belief, _ = estimator.update(belief, np.zeros((RUNS, N)), u, 1.1)
    return estimator.mean(belief)


def broken(x, *_):
    raise KeyError("mass")


def uneven(x, *_):
    return x if x[0] > 0.1 else x[:1]


SHAPE = r"\(3, 5, 2\) for x of shape \(3, 5, 2\) = \(run, point, n\)"


@pytest.mark.parametrize("estimator", [EKF, UKF])
@pytest.mark.parametrize(
    ("wrong", "error", "message"),
    [
        (lambda x, *_: [x[..., 0], x[..., 1]], DimensionError, rf"list of 2; np.stack.*{SHAPE}"),
        (lambda x, *_: [x[..., 0], 0.0], DimensionError, rf"list of object; .* shape {SHAPE}"),
        (lambda *_: 1.0, DimensionError, rf"shape \(\); expected {SHAPE}"),
        (lambda x, *_: x[..., 0], DimensionError, rf"shape \(3, 5\); expected {SHAPE}"),
        (lambda *_: None, DimensionError, rf"NoneType of object; .* shape {SHAPE}"),
        (lambda *_: "a", DimensionError, rf"str of <U1; .* shape {SHAPE}"),
        (lambda x, *_: x.astype("f4"), DimensionError, rf"ndarray of float32; .* shape {SHAPE}"),
        (lambda x, *_: x + 1j, DimensionError, rf"ndarray of complex128; .* shape {SHAPE}"),
        (broken, ModelError, r"KeyError: 'mass' .*; it .* arguments, arrays of shapes "
         r"\(3, 5, 2\) and \(3, 5, 0\)"),
        (lambda x: x, ModelError, "TypeError: .*takes 1 positional argument but . were given"),
    ],
)  # fmt: skip
def test_a_function_of_many_states(estimator, wrong, error, message):
    for name in ("f", "h"):
        with pytest.raises(error, match=f"^{name} (returned|raised) {message}"):
            use(estimator(model(**{name: wrong})))


@pytest.mark.parametrize(
    ("wrong", "error", "message"),
    [
        (uneven, DimensionError, r"^f returned shape \(1,\); expected \(2,\) for one state"),
        (lambda *_: 1.0, DimensionError, r"^f returned shape \(\); expected \(2,\) for one state"),
        (lambda *_: None, DimensionError, "^f returned NoneType of object; expected float64"),
        (broken, ModelError, r"^f raised KeyError: .* arrays of shapes \(2,\) and \(0,\)"),
    ],
)
def test_a_function_of_one_state(wrong, error, message):
    with pytest.raises(error, match=message):
        use(EKF(model(f=wrong, batched=False)))


def later(matrix):
    return lambda t, *_: matrix if t > 0 else np.eye(N)


@pytest.mark.parametrize(
    ("wrong", "error", "message"),
    [
        ({"f_jacobian": lambda x, *_: [[1.0, x[:, 0]], [0.0, 1.0]]}, DimensionError,
         r"f_jacobian returned list of object; expected float64 numbers, shape \(3, 2, 2\)"),
        ({"h_jacobian": broken}, ModelError, "h_jacobian raised KeyError"),
        ({"f": None}, ModelError, "f is of type NoneType; give a function"),
        ({"h_jacobian": np.eye(N)}, ModelError, "h_jacobian is of type ndarray; give a function"),
        ({"Q": [[1.0, 0.0], [0.0]]}, DimensionError, "Q is list of object; expected float64"),
        ({"Q": lambda t: np.eye(N)}, ModelError, "Q raised TypeError: .*called with 2 arguments"),
        ({"R": later(None)}, DimensionError, "R returned NoneType of object; .* a matrix"),
        ({"R": later(-np.eye(N))}, CovarianceError, "R is not .* definite at t = 1.1: .*raise"),
        ({"R": later(np.nan * np.eye(N))}, CovarianceError, "R is not .* definite at t = 1.1"),
        ({"Q": later(-np.eye(N))}, CovarianceError, "Q is not .* semidefinite at t = 1: .*raise"),
        ({"noise_gain": np.ones(N)}, DimensionError, r"noise_gain has shape \(2,\); expected"),
        ({"noise_gain": lambda *_: None, "n_states": N}, DimensionError,
         "noise_gain returned NoneType of object"),
    ],
)  # fmt: skip
def test_jacobians_and_noise(wrong, error, message):
    with pytest.raises(error, match=f"^{message}"):
        use(EKF(model(**wrong)))


def test_matrices_may_be_given_as_lists():
    lists = model(Q=[[2.0, 0.0], [0.0, 2.0]], R=[[1, 0], [0, 1]], noise_gain=[[1.0, 0], [0, 2.0]])
    arrays = model(Q=2 * np.eye(N), noise_gain=np.diag([1.0, 2.0]))
    np.testing.assert_array_equal(use(EKF(lists)), use(EKF(arrays)))


@pytest.mark.parametrize("estimator", [EKF, UKF])
def test_a_state_that_cannot_be_computed_ends_its_own_run_only(estimator):
    def f(x, u, t, dt):
        return np.where(np.arange(RUNS)[:, None, None] == 1, np.nan, x)

    np.testing.assert_array_equal(
        np.isnan(use(estimator(model(f=f)))), [[False] * N, [True] * N, [False] * N]
    )


def test_a_continuous_model_says_the_same():
    def made(**wrong):
        parts = {"f": lambda x, *_: -x, "h": lambda x, *_: x, "Q_s": np.eye(N), "R": np.eye(N)}
        return EKF(ContinuousFunctionModel(**{**parts, **wrong}))

    with pytest.raises(ModelError, match=r"^f raised KeyError"):
        use(made(f=broken))
    with pytest.raises(CovarianceError, match=r"^R is not .* definite at t = 1\.1"):
        use(made(R=later(-np.eye(N))))
    with pytest.raises(DimensionError, match=r"^Q_s returned NoneType"):
        use(made(Q_s=later(None)))
