"""PPO on the cart-pole that sees the EKF's estimate, and on the same that sees raw readings.

Needs the extra `sb3`. On 2 cores it takes a few minutes:

    python examples/ppo_cartpole.py --steps 400000
"""

import argparse
import time
from typing import Any

import numpy as np
from stable_baselines3 import PPO  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.callbacks import BaseCallback  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.vec_env import VecNormalize  # pyright: ignore[reportMissingImports]

from estbench.consistency.intervals import mean_interval
from estbench.envs.sb3 import BatchVecEnv

ID = "estbench/CartPole-v0"


def evaluate(model: PPO, training: VecNormalize, observe: str, episodes: int = 100) -> str:
    """Return and length of one deterministic episode of each of many robots, as text."""
    env = BatchVecEnv(ID, episodes, observe=observe)
    env.seed(10_000)
    observations: Any = env.reset()
    total, steps = np.zeros(episodes), np.zeros(episodes)
    running = np.ones(episodes, bool)
    while running.any():
        actions, _ = model.predict(training.normalize_obs(observations), deterministic=True)
        observations, rewards, over, _ = env.step(actions)
        total[running] += rewards[running]
        steps[running] += 1
        running &= ~over
    env.close()
    score = mean_interval(total)
    upright = np.mean(steps == steps.max()) if steps.max() >= 500 else 0.0
    return (
        f"return {score.value:6.1f} ± {0.5 * (score.high - score.low):4.1f}, "
        f"{steps.mean():5.1f} of 500 steps, {upright:4.0%} upright to the end"
    )


class Curve(BaseCallback):
    """Prints an evaluation every so many steps."""

    def __init__(self, training: VecNormalize, observe: str, every: int):
        super().__init__()
        self._env, self._observe, self._every, self._due = training, observe, every, 0
        self._began = time.monotonic()

    def _on_rollout_end(self) -> None:
        if self.num_timesteps >= self._due:
            self._due += self._every
            text = evaluate(self.model, self._env, self._observe)  # pyright: ignore
            took = time.monotonic() - self._began
            print(f"  {self.num_timesteps:7d} steps, {took:4.0f} s: {text}", flush=True)

    def _on_step(self) -> bool:
        return True


def train(observe: str, steps: int, num_envs: int, seed: int) -> None:
    """Train on one kind of observation and print the curve."""
    print(f"observe = {observe!r}")
    env = VecNormalize(BatchVecEnv(ID, num_envs, observe=observe), norm_reward=False)
    env.seed(seed)
    model = PPO(
        "MlpPolicy", env, n_steps=64, batch_size=1024, n_epochs=10, learning_rate=1e-3,
        gamma=0.98, gae_lambda=0.9, seed=seed, device="cpu",
    )  # fmt: skip
    print(f"  before:  {evaluate(model, env, observe)}")
    model.learn(steps, callback=Curve(env, observe, steps // 8))
    print(f"  after:   {evaluate(model, env, observe)}")
    env.close()


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=400_000)
    parser.add_argument("--envs", type=int, default=64)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    for kind in ("state", "raw"):
        train(kind, arguments.steps, arguments.envs, arguments.seed)
