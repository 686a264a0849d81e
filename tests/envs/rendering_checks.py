# pyright: reportOptionalMemberAccess=false, reportArgumentType=false
# pyright: reportOptionalSubscript=false, reportGeneralTypeIssues=false, reportOptionalIterable=false
"""Run by test_rendering.py in a process that has MUJOCO_GL set before MuJoCo is imported."""

import sys
import traceback
import warnings
from pathlib import Path
from unittest import mock

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.utils.env_checker import check_env

from estbench.envs import EnvError
from estbench.envs.native import ScenarioEnv
from estbench.envs.rendering import GhostRenderer, ellipsoid, tracked_bodies
from estbench.scenario import load
from estbench.setup import build


def frame(name="Quadrotor", steps=0, **kwargs):
    env = gym.make(f"estbench/{name}-v0", render_mode="rgb_array", width=160, height=120, **kwargs)
    env.reset(seed=1)
    for _ in range(steps):
        env.step(np.zeros(env.action_space.shape, np.float32))
    picture = env.render()
    env.close()
    env.close()
    return picture


def colour(picture, low, high):
    """Share of the pixels between two colours."""
    return np.mean(((picture >= low) & (picture <= high)).all(axis=-1))


def pictures():
    with_ghost, without = frame(), frame(ghost=False)
    assert with_ghost.shape == (120, 160, 3)
    assert with_ghost.dtype == np.uint8
    changed = (with_ghost != without).any(axis=-1).mean()
    assert 0.02 < changed < 0.6, changed
    orange = [colour(p, (190, 120, 0), (255, 200, 120)) for p in (with_ghost, without)]
    assert orange[0] > orange[1] + 0.02, orange
    np.testing.assert_array_equal(frame(), with_ghost)
    np.testing.assert_array_equal(frame(estimator=None, observe="truth"), without)
    later = frame(steps=40)  # the filter has converged, the ellipsoid has shrunk
    assert colour(later, (190, 120, 0), (255, 200, 120)) < orange[0]


def vectors():
    env = gym.make_vec("estbench/CartPole-v0", 3, render_mode="rgb_array", width=80, height=60)
    env.reset(seed=0)
    frames = env.render()
    assert len(frames) == 3
    assert all(f.shape == (60, 80, 3) for f in frames)
    assert (frames[0] != frames[1]).any()
    env.close()


def checks():
    modes = {"render_modes": ["rgb_array"]}  # there is no display
    with warnings.catch_warnings(), mock.patch.dict(ScenarioEnv.metadata, modes):
        warnings.simplefilter("error")
        for name in ("Pendulum", "CartPole", "Acrobot", "Quadrotor"):
            check_env(gym.make(f"estbench/{name}-v0", width=64, height=48).unwrapped)


def videos():
    folder = Path(sys.argv[1])
    try:
        import moviepy  # noqa: F401
    except ImportError:
        env = wrappers.RenderCollection(
            gym.make("estbench/CartPole-v0", render_mode="rgb_array", width=64, height=48)
        )
        env.reset(seed=0)
        env.step(np.zeros(1, np.float32))
        assert len(env.render()) == 2
        return
    env = gym.make("estbench/CartPole-v0", render_mode="rgb_array", width=64, height=48)
    env = wrappers.RecordVideo(env, str(folder), disable_logger=True)
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.zeros(1, np.float32))
    env.close()
    assert list(folder.glob("*.mp4"))


def ellipsoids():
    plant = build(load("quadrotor")).plant
    data = mujoco.MjData(plant.model)
    data.qpos = plant.x0[:7]
    mujoco.mj_forward(plant.model, data)
    P = np.diag([0.01, 0.04, 0.09] + [1e-4] * 9)
    assert tracked_bodies(plant.model) == [1]
    center, axes, frame = ellipsoid(plant.model, data, 1, P)
    np.testing.assert_allclose(center, [0, 0, 1])
    np.testing.assert_allclose(sorted(axes), [0.3, 0.6, 0.9])
    np.testing.assert_allclose(frame @ np.diag(axes**2 / 9) @ frame.T, P[:3, :3], atol=1e-12)
    assert np.isclose(np.linalg.det(frame), 1)
    # Of a pendulum, J P Jᵀ is flat across the swing and as wide as the arm's centre moves.
    plant = build(load("pendulum")).plant
    data = mujoco.MjData(plant.model)
    mujoco.mj_forward(plant.model, data)
    _, axes, _ = ellipsoid(plant.model, data, 1, np.diag([0.01, 1.0]))
    arm = np.linalg.norm(data.xipos[1] - [0, 0, 0.8])
    np.testing.assert_allclose(sorted(axes), [4e-3, 4e-3, 0.3 * arm], rtol=1e-6)


def errors():
    model = build(load("cartpole")).plant.model
    with pytest.raises(EnvError, match="camera is 'vieww'"):
        GhostRenderer(model, 10, 10, "vieww")
    env = gym.make("estbench/CartPole-v0", render_mode="human")
    with pytest.raises(EnvError, match="needs a display; use render_mode='rgb_array'"):
        env.reset()
    wide = GhostRenderer(model, 2000, 1000)
    assert wide.render("rgb_array", np.array([np.nan, 0, 0, 0])).shape == (1000, 2000, 3)


if __name__ == "__main__":
    for name in ("pictures", "vectors", "checks", "videos", "ellipsoids", "errors"):
        try:
            globals()[name]()
            print(f"{name}: ok")
        except Exception:
            print(f"{name}: {traceback.format_exc()[-1500:]!r}")
