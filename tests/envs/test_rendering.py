# pyright: reportOptionalMemberAccess=false, reportArgumentType=false
# pyright: reportOptionalSubscript=false, reportGeneralTypeIssues=false
import os
import shutil
import subprocess
import sys
import warnings
from unittest import mock

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.utils.env_checker import check_env

import estbench.envs  # noqa: F401
from estbench.envs.native import ScenarioEnv
from estbench.envs.rendering import GhostRenderer
from estbench.experiment.setup import build
from estbench.report.rendering import render, scene, window
from estbench.scenario.load import load
from tests.report.conftest import needs_gl


def picture(name="Quadrotor", steps=0, **kwargs):
    env = gym.make(f"estbench/{name}-v0", render_mode="rgb_array", width=160, height=120, **kwargs)
    env.reset(seed=1)
    for _ in range(steps):
        env.step(np.zeros(env.action_space.shape, np.float32))
    pixels = env.render()
    env.close()
    env.close()
    return pixels


def purple(pixels):
    """Share of the pixels that the ellipsoid colours."""
    red, green, blue = np.moveaxis(pixels.astype(int), -1, 0)
    return ((red - green > 15) & (blue - green > 15)).mean()


@needs_gl
def test_a_picture_has_the_ghost_and_the_ellipsoid_in_it():
    with_ghost, without = picture(), picture(ghost=False)
    assert with_ghost.shape == (120, 160, 3)
    assert with_ghost.dtype == np.uint8
    assert 0.05 < (with_ghost != without).any(axis=-1).mean() < 0.6
    assert purple(with_ghost) > 0.05
    assert purple(without) == 0
    np.testing.assert_array_equal(picture(), with_ghost)
    np.testing.assert_array_equal(picture(estimator=None, observe="truth"), without)
    assert purple(picture(steps=40)) < 0.01  # the filter has converged, the ellipsoid has shrunk


@needs_gl
def test_a_vector_gives_a_picture_a_row():
    env = gym.make_vec("estbench/CartPole-v0", 3, render_mode="rgb_array", width=80, height=60)
    env.reset(seed=0)
    frames = env.render()
    assert len(frames) == 3
    assert all(f.shape == (60, 80, 3) for f in frames)
    assert (frames[0] != frames[1]).any()
    env.close()


@needs_gl
@pytest.mark.parametrize("name", ["Pendulum", "CartPole", "Acrobot", "Quadrotor"])
def test_the_checker_passes_with_rendering_and_without_a_warning(name):
    modes = {"render_modes": ["rgb_array"]}  # there is no display
    with warnings.catch_warnings(), mock.patch.dict(ScenarioEnv.metadata, modes):
        warnings.simplefilter("error")
        check_env(gym.make(f"estbench/{name}-v0", width=64, height=48).unwrapped)


@needs_gl
def test_pictures_can_be_collected():
    env = gym.make("estbench/CartPole-v0", render_mode="rgb_array", width=64, height=48)
    env = wrappers.RenderCollection(env)
    env.reset(seed=0)
    env.step(np.zeros(1, np.float32))
    assert len(env.render()) == 2
    env.close()


@needs_gl
def test_record_video(tmp_path):
    pytest.importorskip("moviepy")
    env = gym.make("estbench/CartPole-v0", render_mode="rgb_array", width=64, height=48)
    env = wrappers.RecordVideo(env, str(tmp_path), disable_logger=True)
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.zeros(1, np.float32))
    env.close()
    assert list(tmp_path.glob("*.mp4"))


@needs_gl
def test_a_wide_picture_of_a_state_that_is_not_finite():
    renderer = GhostRenderer(build(load("cartpole")).plant.model, 2000, 1000)
    assert renderer.render("rgb_array", np.array([np.nan, 0, 0, 0])).shape == (1000, 2000, 3)
    renderer.close()


@pytest.mark.parametrize("camera", ["vieww", 7, -2])
def test_an_unknown_camera(camera):
    model = build(load("cartpole")).plant.model
    with pytest.raises(render.RenderError, match=rf"camera is {camera!r}; the model has view"):
        GhostRenderer(model, 10, 10, camera)


class FakeViewer:
    """What `human` mode uses of MuJoCo's viewer, without a display."""

    def __init__(self, model):
        self.user_scn = mujoco.MjvScene(model, 100)
        self.cam = mujoco.MjvCamera()
        self.synced, self.running = [], True

    def lock(self):
        return mock.MagicMock()

    def is_running(self):
        return self.running

    def sync(self):
        geoms = [self.user_scn.geoms[i] for i in range(self.user_scn.ngeom)]
        self.synced.append([(g.type, g.pos.copy(), g.mat.copy(), g.size.copy()) for g in geoms])

    def close(self):
        self.running = False


@pytest.fixture
def viewers(monkeypatch):
    """The viewers that are opened."""
    opened = []

    def launch_passive(model, data, **_):
        opened.append(FakeViewer(model))
        opened[-1].data = data
        return opened[-1]

    monkeypatch.setattr(window, "start", lambda remedy: None)
    viewer = mock.MagicMock(launch_passive=launch_passive)
    monkeypatch.setitem(sys.modules, "mujoco.viewer", viewer)
    monkeypatch.setattr(mujoco, "viewer", viewer, raising=False)
    return opened


def test_human_mode_shows_every_reset_and_step(viewers):
    env = gym.make("estbench/Quadrotor-v0", render_mode="human")
    assert viewers == []  # none before there is something to see
    env.reset(seed=0)
    (viewer,) = viewers
    assert viewer.cam.type == mujoco.mjtCamera.mjCAMERA_FIXED
    *_, info = env.step(np.zeros(4, np.float32))
    assert len(viewer.synced) == 2
    np.testing.assert_allclose(viewer.data.qpos, info["truth"][:7])

    model = env.unwrapped._renderer._model
    data = mujoco.MjData(model)
    scene.pose(model, data, info["estimate"])
    moving = [g for g in range(model.ngeom) if model.body_weldid[model.geom_bodyid[g]] != 0]
    *ghost, (kind, centre, frame, axes) = viewer.synced[-1]
    assert len(ghost) == len(moving)
    for (_, pos, mat, _), g in zip(ghost, moving, strict=True):
        np.testing.assert_allclose(pos, data.geom_xpos[g], atol=1e-6)
        np.testing.assert_allclose(mat.ravel(), data.geom_xmat[g], atol=1e-6)
    assert kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID
    np.testing.assert_allclose(centre, info["estimate"][:3], atol=1e-6)
    cov = env.unwrapped.world.filter.cov[0, :3, :3]
    np.testing.assert_allclose(frame @ np.diag(axes**2) @ frame.T, 9 * cov, rtol=1e-4, atol=1e-7)

    env.reset(seed=1)
    assert len(viewer.synced) == 3
    viewer.running = False  # its user closes it: the environment goes on
    env.step(np.zeros(4, np.float32))
    assert len(viewer.synced) == 3
    env.close()
    assert viewers == [viewer]


def test_close_closes_the_window(viewers):
    env = gym.make("estbench/CartPole-v0", render_mode="human", ghost=False)
    env.reset(seed=0)
    assert viewers[0].synced == [[]]  # no ghost
    env.close()
    assert not viewers[0].running


@pytest.mark.parametrize(
    ("display", "reason"),
    [(None, "needs a display, and DISPLAY is not set"), (":4711", "on display ':4711'")],
)
def test_human_mode_without_a_display(monkeypatch, display, reason):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    if display:
        pytest.importorskip("glfw")
        monkeypatch.setenv("DISPLAY", display)
    env = gym.make("estbench/CartPole-v0", render_mode="human")
    with pytest.raises(window.WindowError, match=f"{reason}; use render_mode='rgb_array'"):
        env.reset()


REAL = """
import gymnasium as gym, numpy as np, estbench.envs
env = gym.make("estbench/CartPole-v0", render_mode="human")
env.reset(seed=0)
for _ in range(10):
    env.step(np.zeros(1, np.float32))
viewer = env.unwrapped._renderer._shown._window.viewer
print(viewer.is_running(), viewer.user_scn.ngeom)
env.close()
"""


@pytest.mark.skipif(shutil.which("xvfb-run") is None, reason="no Xvfb: apt-get install xvfb")
def test_human_mode_on_a_virtual_display():
    done = subprocess.run(
        ["xvfb-run", "-a", sys.executable, "-c", REAL],
        env={k: v for k, v in os.environ.items() if "DISPLAY" not in k},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.stdout.split() == ["True", "3"], done.stderr[-500:]
    assert done.returncode == 0
