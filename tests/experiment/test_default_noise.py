"""The default process noise fits the robot's inertia."""

import mujoco
import numpy as np
import pytest

import estbench
from estbench.experiment.build import default_force_density

BALL = """<mujoco><option timestep="0.005" gravity="0 0 0"/><worldbody>
<body><freejoint name="r"/><geom size="{size}" mass="{mass}"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize(("size", "mass"), [(0.02, 0.02), (0.5, 500.0)])
def test_forces_are_scaled_by_the_inertia(size, mass):
    model = mujoco.MjModel.from_xml_string(BALL.format(size=size, mass=mass))
    inertia = 0.4 * mass * size**2
    expected = 0.01 * np.array([mass**2] * 3 + [inertia**2] * 3)
    np.testing.assert_allclose(default_force_density(model), expected, rtol=1e-12)


def test_a_robot_of_20_grams_survives_the_default_force(tmp_path):
    """A density of 0.01 (N m)² s turns it by 31000 rad/s within 1 s."""
    (tmp_path / "ball.xml").write_text(BALL.format(size=0.02, mass=0.02), encoding="utf-8")
    results = estbench.run(
        str(tmp_path / "ball.xml"), ["ekf"], runs=8, duration=0.2,
        overrides=["process_noise.kind=force", "initial.std=0.01"],
    )  # fmt: skip
    assert not results["ekf"].failures
    assert results["ekf"].diverged == 0
    assert any("as forces scaled by the robot's inertia" in n for n in results.notices)


def test_a_base_that_its_damping_holds_is_not_shaken(tmp_path):
    """As Fetch's: noise on a velocity that a damping of 1e11 stops would be a force of 1e8 N."""
    path = tmp_path / "robot.xml"
    path.write_text(
        '<mujoco><worldbody><body><joint name="base" type="slide" damping="1e11"/>'
        '<geom size="0.1"/><body><joint name="arm" axis="0 1 0"/><geom size="0.05" pos="1 0 0"/>'
        "</body></body></worldbody></mujoco>"
    )
    results = estbench.run(path, "ukf", runs=3, duration=0.1)
    assert results["ukf"].verdict != "simulation failed"
    assert results["ukf"].diverged == 0.0
    assert any(n.startswith("base: the damping stops any motion") for n in results.notices)
