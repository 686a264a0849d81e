"""The symmetries of a robot on level ground."""

import numpy as np
import pytest

from estbench.errors import ScenarioError
from estbench.experiment import setup
from estbench.models.symmetric import SymmetricModel
from estbench.montecarlo import run as experiment
from tests.helpers import mujoco_model


def test_a_robot_moves_alike_wherever_it_is_and_whatever_way_it_looks():
    """The quadruped on its feet, turned and pushed: f(x ⊞ ε N c) ⊖ f(x) is in the span of N'."""
    model = setup.build(experiment.resolve("quadruped")).model()
    assert isinstance(model, SymmetricModel)
    space, rng, eps = model.space, np.random.default_rng(0), 1e-4
    x = np.concatenate([model.mjmodel.key_qpos[0], np.zeros(model.mjmodel.nv)])[None]
    move = np.zeros((4, space.n))
    move[:, :6] = [0.3, -0.2, -0.004, 0.02, -0.03, 2.0] * rng.standard_normal((4, 6)) ** 2
    move[:, space.n // 2 :] = 0.3 * rng.standard_normal((4, space.n // 2))
    x = space.plus(x.repeat(4, axis=0), move)
    u = np.tile(model.mjmodel.key_ctrl[0], (4, 1))
    N, after = model.symmetries(x), model.transition(x[:, None], u, 0.0, 0.01)[:, 0]
    basis = np.linalg.qr(model.symmetries(after))[0]
    for way in range(3):
        for sign in (1, -1):
            there = space.plus(x, sign * eps * N[:, :, way])
            moved = space.minus(model.transition(there[:, None], u, 0.0, 0.01)[:, 0], after) / eps
            assert np.linalg.norm(moved, axis=1).min() > 0.9
            left = moved - (basis @ (basis.mT @ moved[..., None]))[..., 0]
            assert np.abs(left).max() < 2e-3


def test_a_robot_that_is_fixed_to_the_world_has_none():
    with pytest.raises(ScenarioError, match="one robot with a free joint under gravity only"):
        _ = mujoco_model("ball").symmetries
