"""
# A policy on estimates, trained and judged

A linear policy balances the cart-pole. The cross-entropy method trains one that sees the EKF's
estimate and one that sees the raw readings and their differences, each on an environment of 64
robots at once. Both are then judged on new episodes, by the mean return with its interval.
Differences of noisy readings are a poor velocity: with them the training is slower, and the return
lower.
"""

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np

import estbench.envs  # noqa: F401  (registers the environments)
from estbench.consistency.intervals import mean_interval

ROWS, STEPS, ITERATIONS, KEPT = 64, 200, 8, 10


def returns(env, gains, seed, differences):
    """Return of each row under u = -K x̂, or of readings and their rates."""
    seen, _ = env.reset(seed=seed)
    total, alive, last = np.zeros(ROWS), np.ones(ROWS, bool), seen
    for _ in range(STEPS):
        x = np.concatenate([seen, (seen - last) / 0.01], axis=1) if differences else seen
        last = seen
        action = np.clip(-(gains * x).sum(axis=1, keepdims=True), -1.0, 1.0)
        seen, reward, over, cut, _ = env.step(action.astype(np.float32))
        total += np.where(alive, reward, 0.0)
        alive &= ~(over | cut)
    return total


def train(observe, differences):
    """The gain after the last iteration, the course of the returns, and those of new episodes."""
    env = gym.make_vec("estbench/CartPole-v0", ROWS, estimator="ekf", observe=observe)
    rng = np.random.default_rng(0)
    mean, std, course = np.zeros(4), np.array([1.0, 3.0, 1.0, 1.0]), []
    for k in range(ITERATIONS):
        gains = mean + std * rng.standard_normal((ROWS, 4))
        scores = returns(env, gains, 1000 * (k + 1), differences)
        best = gains[np.argsort(scores)[-KEPT:]]
        mean, std = best.mean(axis=0), best.std(axis=0) + 0.05
        course.append(scores.mean())
    judged = returns(env, np.tile(mean, (ROWS, 1)), 10**6, differences)
    env.close()
    return course, mean_interval(judged)


figure, axes = plt.subplots(figsize=(7, 3.5), layout="constrained")
for name, observe in {"estimate": "state", "readings": "raw"}.items():
    course, judged = train(observe, observe == "raw")
    score = f"{judged.value:.1f} [{judged.low:.1f}, {judged.high:.1f}] of {STEPS}"
    axes.plot(course, "o-", label=f"{name}; judged: {score}")
axes.set(xlabel="iteration", ylabel="mean return while training",
         title="Cart-pole: a linear policy on estimates and on readings")  # fmt: skip
axes.legend(loc="lower right")
plt.show()
