"""x̂₀ and P₀ on the constraint manifold."""

import numpy as np
import pytest

import estbench
from estbench.experiment import setup
from estbench.scenario.load import resolve
from tests.loops import COUPLED, FOUR_BAR


def prepared(path, *overrides):
    return setup.build(resolve(str(path), "ekf", 8, 0, 0.02, ["bound=false", *overrides]))


@pytest.fixture(params=[FOUR_BAR, COUPLED], ids=["four_bar", "coupled"])
def robot(request, tmp_path):
    path = tmp_path / "loop.xml"
    path.write_text(request.param)
    return path


def test_default_prior_of_a_closed_loop_is_consistent(robot):
    """Seeded: the same numbers at every run. Mean over 40 runs and 50 steps."""
    found = estbench.run(robot, ["ekf", "ukf"], runs=40, duration=0.1, overrides=["bound=false"])
    for summary in found.summaries:
        assert summary.anees.value == pytest.approx(1.0, abs=0.2)
    assert any("on the equality constraints" in line for line in found.notices)
    loose = ["bound=false", "initial.std=0.05", "initial.constraints=none"]
    before = estbench.run(robot, "ekf", runs=10, duration=0.1, overrides=loose)
    assert before.summaries[0].anees.value > 2.0  # 9.5 and 2.8


def test_moments_are_those_of_the_draws(robot):
    made = prepared(robot, "initial.std=0.05")
    drawn = made.simulator(range(2000)).x
    errors = made.space.minus(drawn, made.mean)
    std = np.sqrt(np.diag(made.cov))
    # Four standard errors of a mean and of a standard deviation of 2000 draws.
    assert np.abs(errors.mean(axis=0) / std).max() < 4 / np.sqrt(2000)
    np.testing.assert_allclose(errors.std(axis=0), std, rtol=4 / np.sqrt(2 * 2000) + 0.01)
    rank = np.linalg.matrix_rank(made.cov, tol=1e-3 * std.min() ** 2, hermitian=True)
    assert rank == made.space.n - (4 if "rocker" in made.space.names else 2)


def test_projection_can_be_switched_off(robot):
    made = prepared(robot, "initial.constraints=none", "initial.std=0.03")
    np.testing.assert_array_equal(made.cov, 0.03**2 * np.eye(made.space.n))
    assert not any("equality" in line for line in made.notices)


def test_a_start_off_the_constraints_is_moved_with_a_notice(robot):
    first = prepared(robot).space.names[0]
    made = prepared(robot, "initial.qpos=[0.0, 0.2, 0.1]")
    assert any("the start itself violates" in line for line in made.notices)
    assert first in made.space.names


def test_parts_that_overlap_in_the_pose_of_the_file_are_named(tmp_path):
    """Two fingers of a gripper, 30 mm deep in each other; excluded, nothing is said."""
    finger = '<body name="{0}" pos="{1} 0 1"><joint name="{0}" axis="0 1 0"/>{2}</body>'
    geoms = ['<geom size="0.02"/>', '<geom name="pad" size="0.02"/>']
    bodies = "".join(finger.format(*row) for row in zip("ab", (0, 0.01), geoms, strict=True))
    mjcf = "<mujoco>{}<worldbody>" + bodies + "</worldbody></mujoco>"
    path = tmp_path / "gripper.xml"
    path.write_text(mjcf.format(""))
    assert "geom0 and pad overlap at the start, by up to 30.0 mm" in str(prepared(path).notices)
    path.write_text(mjcf.format('<contact><exclude body1="a" body2="b"/></contact>'))
    assert "overlap" not in str(prepared(path).notices)
