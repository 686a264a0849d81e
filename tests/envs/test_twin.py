"""The twin of an environment has the environment's attributes as they are at each step."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv

from estbench.envs import EstimatedObservation


class Reaching(InvertedPendulumEnv):
    """A goal over a class default, and an attribute that comes and goes, in the observation."""

    size = 1
    goal = np.zeros(1)

    def __init__(self):
        super().__init__()
        n = 4 + self.size + 1
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (n,), np.float64)

    def reset_model(self):
        """Draw a goal; the first reset is that of the constructor's caller."""
        self.goal = self.np_random.uniform(0.1, 1.0, self.size)
        vars(self).pop("bonus", None)
        return super().reset_model()

    def step(self, action):
        """Set or remove `bonus` at every other step."""
        if "bonus" in vars(self):
            del self.bonus
        else:
            self.bonus = 5.0
        out = super().step(action)
        return self._get_obs(), *out[1:]

    def _get_obs(self):
        bonus = self.bonus if "bonus" in vars(self) else -1.0
        return np.concatenate([super()._get_obs(), self.goal, [bonus]])


class Vector(Reaching):
    """A goal of three numbers, over a class default."""

    size = 3
    goal = np.zeros(3)


@pytest.mark.parametrize("kind", [Reaching, Vector])
def test_a_goal_drawn_per_episode_is_seen(kind):
    env = EstimatedObservation(kind(), estimator="ekf", observe="env")
    goals = []
    for seed in (1, 2):
        shown, _ = env.reset(seed=seed)
        goals.append(env.unwrapped.goal.copy())
        assert shown[-1] == -1.0
        np.testing.assert_array_equal(shown[4:-1], goals[-1])
        for bonus in (5.0, -1.0, 5.0):
            shown, *_ = env.step(np.zeros(1))
            np.testing.assert_array_equal(shown[4:], [*goals[-1], bonus])
    assert not np.array_equal(*goals)
    env.close()


class Late(InvertedPendulumEnv):
    """Its observation reads a position of a body from the third step on."""

    count = 0

    def step(self, action):
        """Count the steps."""
        self.count += 1
        return super().step(action)

    def _get_obs(self):
        shown = super()._get_obs()
        if self.count > 2:
            shown[0] = self.data.body("pole").xpos[0]
        return shown


class Own(InvertedPendulumEnv):
    """Its observation is set by a method of its own that steps the physics."""

    pushed = 0.0

    def do_simulation(self, ctrl, n_frames):
        """Remember the position before."""
        self.pushed = float(self.data.qpos[0])
        super().do_simulation(ctrl, n_frames)

    def _get_obs(self):
        return np.concatenate([super()._get_obs()[:3], [self.pushed]])


@pytest.mark.parametrize(
    ("kind", "physics"), [(InvertedPendulumEnv, [0, 0, 0, 0]), (Late, [0, 0, 1, 1]), (Own, [1] * 4)]
)
def test_the_twin_steps_the_physics_only_where_the_observation_reads_it(kind, physics):
    env = EstimatedObservation(kind(), estimator="ekf", observe="env")
    env.reset(seed=1)
    stepped = []
    for _ in physics:
        before = env._watch.filter.estimate[0]
        shown, *_ = env.step(np.full(1, 0.3))
        stepped.append(env._twin._physics)
        filter_ = env._watch.filter
        full = type(env._twin)(env.env)
        full._physics = True
        state = env._member.state()
        _, u = env._watch.divided(state[None])
        again = full.step(before, u[0], 2, filter_.estimate[0], state[0])
        np.testing.assert_array_equal(shown, again)
    assert stepped == physics
    env.close()
