"""Functions that give numbers without an error, and wrong ones, are found before the first step."""

import numpy as np
import pytest

from estbench.errors import EstbenchError, ModelError
from estbench.models.continuous import ContinuousFunctionModel
from estbench.models.function import FunctionModel
from estbench.models.linear import LinearModel
from estbench.models.probe import probe, probe_function

RNG = np.random.default_rng(0)


def in_place(x, *_):
    x[..., 0] += 1.0
    return x


MISTAKES = [
    (lambda x, *_: np.array([x[0] + x[1], x[1]]), "mixes the runs: .* needs batched=False"),
    (lambda x, *_: x + RNG.normal(size=x.shape), "another value when it is called again"),
    (lambda x, *_: x - x.mean(axis=0), "mixes the runs"),
    (in_place, "changes its argument x in place"),
]
FINE = [
    lambda x, *_: x,
    lambda x, *_: np.stack([x[..., 0] + x[..., 1], np.sin(x[..., 1])], axis=-1),
    lambda x, *_: np.stack([x[:, 0], x[:, 1]], axis=-1),  # never asked for points by a KF
    lambda x, *_: x * np.array([1.0, 2.0]).reshape(-1, *(x.ndim - 1) * [1]),  # one per run
]


def tried(model, runs=2, times=(0.0, 1.0, 2.0)):
    mean, cov = np.tile([1.0, 0.5], (runs, 1)), np.tile(np.eye(2), (runs, 1, 1))
    probe(model, mean, cov, np.zeros((runs, 0)), times)


def discrete(**functions):
    given = {"f": FINE[0], "h": FINE[0]} | functions
    return FunctionModel(Q=np.eye(2), R=np.eye(2), **given)


@pytest.mark.parametrize(("wrong", "message"), MISTAKES)
@pytest.mark.parametrize("which", ["f", "h"])
def test_a_function_that_is_not_what_it_seems(which, wrong, message):
    with pytest.raises(ModelError, match=f"^{which} .*{message}"):
        tried(discrete(**{which: wrong}))
    for runs in (1, 3, 4):  # other numbers of runs find it too, or it does no harm
        if runs > 1 or "mixes" not in message:
            with pytest.raises(EstbenchError, match=f"^{which} "):
                tried(discrete(**{which: wrong}), runs)


@pytest.mark.parametrize("fine", FINE)
def test_functions_that_are_right_pass(fine):
    tried(discrete(f=fine, h=fine))
    tried(discrete(f=lambda x, u, t, dt: np.array([x[0] + x[1], x[1]]), batched=False))


def test_jacobians_and_noise_are_tried_too():
    def noisy(x, *_):
        return np.broadcast_to(np.eye(2), (*x.shape, 2)) + 1e-3 * RNG.normal()

    for name in ("f_jacobian", "h_jacobian"):
        with pytest.raises(ModelError, match=f"^{name} gives another value"):
            tried(discrete(**{name: noisy}))
    random = FunctionModel(
        f=FINE[0], h=FINE[0], Q=lambda t, dt: np.eye(2) * RNG.uniform(), R=np.eye(2)
    )
    with pytest.raises(ModelError, match=r"^Q gives another value"):
        tried(random)


@pytest.mark.parametrize(("wrong", "message"), MISTAKES)
def test_a_continuous_model(wrong, message):
    model = ContinuousFunctionModel(f=wrong, h=FINE[0], Q_s=np.eye(2), R=np.eye(2))
    with pytest.raises(ModelError, match=f"^f .*{message}"):
        tried(model)


def test_a_model_of_the_users_own():
    class Own(LinearModel):
        def transition(self, x, u, t=0.0, dt=1.0):
            return super().transition(x, u) + RNG.normal()

    with pytest.raises(ModelError, match=r"^transition gives another value"):
        tried(Own(A=np.eye(2), C=np.eye(2), Q=np.eye(2), R=np.eye(2)))


def test_uneven_steps():
    uneven = (0.0, 0.1, 0.1, 0.4)
    with pytest.raises(ModelError, match=r"of 0.1 s and of 0.3 s, but FunctionModel ignores dt"):
        tried(discrete(), times=uneven)
    tried(discrete(f=lambda x, u, t, dt: x * (1 - dt)), times=uneven)
    growing = FunctionModel(f=FINE[0], h=FINE[0], Q=lambda t, dt: dt * np.eye(2), R=np.eye(2))
    tried(growing, times=uneven)


def test_points_that_are_mixed():
    def mixed(x):
        return x if x.ndim == 2 else x - x.mean(axis=1, keepdims=True)

    with pytest.raises(ModelError, match=r"mixes the points"):
        probe_function("g", mixed, np.array([[1.0, 2.0], [3.0, 5.0]]))
