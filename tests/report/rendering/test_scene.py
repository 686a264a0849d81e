import atexit

import mujoco
import numpy as np
import pytest

from estbench.experiment import setup
from estbench.report.rendering import render, replay, scene
from estbench.scenario import load as scenario
from tests.report.conftest import needs_gl


@pytest.fixture(scope="module")
def quadrotor():
    return setup.build(scenario.load("quadrotor"))


def ghost_of(model, x):
    data = mujoco.MjData(model)
    scene.pose(model, data, x)
    view = mujoco.MjvScene(model, maxgeom=100)
    return data, view, scene.add_ghost(view, model, data)


def test_the_ghost_is_the_estimate(quadrotor):
    space, model = quadrotor.space, quadrotor.plant.model
    delta = np.random.default_rng(0).standard_normal(space.n)
    data, view, added = ghost_of(model, space.plus(quadrotor.mean, delta))
    moving = [g for g in range(model.ngeom) if model.body_weldid[model.geom_bodyid[g]] != 0]
    assert len(added) == len(moving)
    for i, g in zip(added, moving):
        np.testing.assert_allclose(view.geoms[i].pos, data.geom_xpos[g], atol=1e-6)
        np.testing.assert_allclose(view.geoms[i].mat.ravel(), data.geom_xmat[g], atol=1e-6)
        np.testing.assert_allclose(view.geoms[i].rgba, scene.GHOST, atol=1e-6)


def test_the_ellipsoid_is_the_covariance(quadrotor):
    model = quadrotor.plant.model
    rng = np.random.default_rng(1)
    root = rng.standard_normal((12, 12))
    cov = root @ root.T
    data, view, _ = ghost_of(model, quadrotor.mean)
    (body,) = scene.tips(model)
    centre, spread = scene.position_covariance(model, data, body, cov)
    np.testing.assert_allclose(centre, quadrotor.mean[:3])
    np.testing.assert_allclose(spread, cov[:3, :3], atol=1e-12)  # the body's frame is its centre
    index = scene.add_ellipsoid(view, centre, spread)
    assert index is not None
    axes = view.geoms[index].mat.astype(float) @ np.diag(view.geoms[index].size.astype(float))
    np.testing.assert_allclose(axes @ axes.T, 9 * spread, rtol=1e-5, atol=1e-5)


def test_a_hinged_robots_ellipsoid_is_by_sampling():
    prepared = setup.build(scenario.load("acrobot"))
    model, space = prepared.plant.model, prepared.space
    cov = np.diag([1e-3, 4e-3, 1.0, 1.0]) ** 2
    data = mujoco.MjData(model)
    scene.pose(model, data, prepared.mean)
    (body,) = scene.tips(model)
    assert model.body(body).name == "lower"
    _, spread = scene.position_covariance(model, data, body, cov)
    samples = []
    for z in np.random.default_rng(0).standard_normal((4000, space.n)):
        scene.pose(model, data, space.plus(prepared.mean, np.sqrt(np.diag(cov)) * z))
        samples.append(data.xipos[body].copy())
    np.testing.assert_allclose(np.cov(np.array(samples).T), spread, rtol=0.1, atol=1e-7)


def test_what_is_not_finite_is_not_drawn(quadrotor):
    view = mujoco.MjvScene(quadrotor.plant.model, maxgeom=10)
    assert scene.add_ellipsoid(view, np.zeros(3), np.full((3, 3), np.nan)) is None
    assert view.ngeom == 0


@needs_gl
def test_the_frames_ghost_equals_the_stored_estimate(entries):
    (entry,) = entries("full")
    run = replay.of_entry(entry, 2)
    stored = {k: entry.group[k].values[2] for k in ("estimate", "nees", "cov")}
    np.testing.assert_array_equal(run.estimate, stored["estimate"])
    np.testing.assert_array_equal(run.cov, stored["cov"])
    np.testing.assert_array_equal(run.nees, stored["nees"] / entry.source.n)
    with render.Renderer(run.model, 64, 64) as renderer:
        for step in (0, 7, 20):
            ghost = renderer.update(run.truth[step], run.estimate[step], run.cov[step])
            _, view, expected = ghost_of(run.model, stored["estimate"][step])
            for i, j in zip(ghost, expected, strict=True):
                np.testing.assert_array_equal(renderer.scene.geoms[i].pos, view.geoms[j].pos)
                np.testing.assert_array_equal(renderer.scene.geoms[i].mat, view.geoms[j].mat)
            assert renderer.scene.ngeom == ghost.stop + 1  # the ellipsoid


@needs_gl
def test_a_picture_has_the_ghost_in_it(quadrotor):
    space = quadrotor.space
    aside = space.plus(quadrotor.mean, np.r_[0.3, np.zeros(space.n - 1)])
    with render.Renderer(quadrotor.plant.model, 160, 120) as renderer:
        alone = renderer.draw(quadrotor.mean)
        both = renderer.draw(quadrotor.mean, aside, quadrotor.cov)
        lost = renderer.draw(quadrotor.mean, np.full(space.nx, np.nan), quadrotor.cov)
    green = both[..., 1].astype(int) - both[..., 0] > 60
    assert 100 < green.sum() < 8000
    np.testing.assert_array_equal(alone, lost)
    assert render.png(alone).startswith(b"\x89PNG")


UNLIT = """<mujoco>{}<worldbody>{}<body><joint type="hinge" axis="0 1 0"/>
  <geom type="capsule" size="0.05" fromto="0 0 0 0 0 -0.4"/></body></worldbody></mujoco>"""


@needs_gl
def test_a_robot_without_a_light_is_not_left_in_the_dark(monkeypatch):
    model = mujoco.MjModel.from_xml_string(UNLIT.format("", ""))

    def brightness():
        with render.Renderer(model, 80, 60) as renderer:
            pixels = renderer.draw(np.array([0.5, 0.0]), np.array([0.6, 0.0]))
        return pixels[pixels.any(axis=-1)].mean()  # of the robot: what is behind it is black

    bright = brightness()
    monkeypatch.setattr(render, "lit", lambda model: model)
    assert bright > 2 * brightness()
    assert bright > 80


def test_a_light_of_its_own_or_a_bright_headlight_stays_as_it_is(quadrotor):
    bright = '<visual><headlight ambient="0.9 0.9 0.9" diffuse="1 1 1"/></visual>'
    for model in (
        quadrotor.plant.model,
        mujoco.MjModel.from_xml_string(UNLIT.format("", '<light pos="0 0 2"/>')),
        mujoco.MjModel.from_xml_string(UNLIT.format(bright, "")),
    ):
        drawn = scene.lit(model)
        assert drawn is not model
        for what in ("ambient", "diffuse", "specular"):
            now, before = (getattr(m.vis.headlight, what) for m in (drawn, model))
            np.testing.assert_array_equal(now, before)


def test_without_opengl_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setattr(render, "_candidates", lambda: [])
    monkeypatch.setattr(render.platform, "system", lambda: "Linux")
    with pytest.raises(render.RenderError, match="apt-get install libosmesa6"):
        render.context(16, 16)
    assert not render.available()


def test_a_backend_that_was_asked_for_and_does_not_work(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    monkeypatch.setattr(render.platform, "system", lambda: "Linux")
    with pytest.raises(
        render.RenderError, match=r"MUJOCO_GL=glfw does not work; unset it.*display"
    ):
        render.context(16, 16)


def test_an_unknown_camera(quadrotor):
    with pytest.raises(render.RenderError, match=r"camera is 'top'; the model has view"):
        render.Renderer(quadrotor.plant.model, 64, 64, "top")


@needs_gl
def test_a_renderer_that_is_not_closed_is_freed_before_egl_ends_its_display(quadrotor, monkeypatch):
    calls, register = [], atexit.register  # the end of Python runs them from the last to the first
    monkeypatch.setattr(
        atexit, "register", lambda f, *a, **k: calls.append(f) or register(f, *a, **k)
    )
    renderer = render.Renderer(quadrotor.plant.model, 64, 64)
    assert calls[-1] is renderer.close
    renderer.close()
    assert renderer.close() is None  # at the end of Python again
