# pyright: reportOptionalMemberAccess=false, reportArgumentType=false
# pyright: reportOptionalSubscript=false, reportGeneralTypeIssues=false
import numpy as np
import pytest

from estbench.envs.task import Task
from estbench.errors import CovarianceError, DimensionError, ScenarioError
from estbench.experiment import setup
from estbench.scenario import load as scenario
from estbench.scenario.files import bundled


def task(name="cartpole", *overrides):
    loaded = scenario.load(name, overrides)
    return Task.build(loaded, setup.build(loaded).plant)


def test_reward_is_the_formula():
    t = task(
        "cartpole", 'task.target={"cart"=0.5}', 'task.state_weight={"cart"=2.0, "pole.vel"=3.0}',
        "task.control_weight=0.1", "task.alive=4", 'task.bounds={"cart"=1.0}',
    )  # fmt: skip
    x = np.array([[0.3, 0.1, 9.0, 0.2], [1.6, 0, 0, 0], [np.nan, 0, 0, 0]])
    u = np.array([[3.0], [50.0], [0.0]])  # the second is clamped to 20
    reward, ended = t.reward(x, u)
    expected = 4 - 2 * 0.2**2 - 3 * 0.2**2 - 0.1 * 3**2
    np.testing.assert_allclose(reward, [expected, -2 * 1.1**2 - 0.1 * 20**2, 0.0])
    assert ended.tolist() == [False, True, True]


def test_control_is_counted_from_the_keyframe():
    t = task("quadrotor")
    hover = t.plant.x0[None], t.plant.u0[None]
    assert t.cost(*hover)[0] == 0
    assert t.reward(*hover)[0][0] == 1
    turned = t.plant.space.plus(t.plant.x0, 1.3 * np.eye(12)[3])[None]
    assert t.outside(turned)[0]  # rx is bounded at 1.2 rad


def test_horizon():
    assert task("cartpole").steps == 500
    assert task("cartpole", "task.horizon=0.25").steps == 25
    assert task("cartpole", "simulation.duration=2").steps == 200
    assert task("cartpole", "model.frame_skip=5", "task.horizon=1").steps == 20


@pytest.mark.parametrize("name", bundled())
def test_bundled_tasks_fit_their_robots(name):
    t = task(name)
    assert not t.outside(t.goal[None])[0]
    assert t.state_weight.max() > 0


@pytest.mark.parametrize(
    ("override", "error", "message"),
    [
        (
            'task.bounds={"pol"=1}',
            ScenarioError,
            "task.bounds: 'pol' matches none .did you mean 'pole'",
        ),
        (
            "task.state_weight=[1, 2]",
            DimensionError,
            "task.state_weight has 2 values; expected 1 or 4",
        ),
        ("task.control_weight=-1", CovarianceError, "task.control_weight is -1; a cost needs"),
        (
            'task.bounds={"pole"=0}',
            ScenarioError,
            "task.bounds.pole: Input should be greater than 0",
        ),
        ("task.horizon=-1", ScenarioError, "task.horizon: Input should be greater than 0"),
        ("task.targt=1", ScenarioError, "task.targt: unknown key .did you mean 'target'"),
    ],
)
def test_bad_tasks(override, error, message):
    with pytest.raises(error, match=message):
        task("cartpole", override)
