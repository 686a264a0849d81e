"""What a filter adds to a Gymnasium step: `python -m benchmarks.envs`.

Two targets: a wrapped InvertedPendulum-v5 with an EKF adds at most 150 microseconds a
step; the vector CartPole with 256 rows and an EKF does at least 60,000 environment steps a second
on 2 cores. The floor beside each is the time of the bare `Batch` calls that the filter makes.
"""

import logging
import os
import time
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

import estbench.envs
from estbench.envs import EstimatedObservation

REPETITIONS = 5
ROWS = 256


def best(call: Callable[[], Any], count: int = 300) -> float:
    """The 10th percentile of a call's time, µs: what it costs when nothing else disturbs it."""
    for _ in range(10):
        call()
    times = []
    for _ in range(count):
        began = time.perf_counter()
        call()
        times.append(time.perf_counter() - began)
    return 1e6 * float(np.percentile(times, 10))


def stepping(env: gym.Env) -> Callable[[], None]:
    """A function that steps, resetting where an episode ends outside of what is timed."""
    action = np.zeros(env.action_space.shape or (), np.float32)
    env.reset(seed=0)

    def step() -> None:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()

    return step


def scalar() -> None:
    bare = stepping(gym.make("InvertedPendulum-v5"))
    print(
        f"InvertedPendulum-v5 (RK4, 2 physics steps per step); µs per step, median of {REPETITIONS}"
    )
    base = float(np.median([best(bare) for _ in range(REPETITIONS)]))
    print(f"  without a wrapper            {base:8.1f}")
    for observe in ("raw", "state", "env"):
        env = EstimatedObservation(gym.make("InvertedPendulum-v5"), "ekf", observe=observe)
        step = stepping(env)
        added = [best(step) - base for _ in range(REPETITIONS)]
        verdict = "" if observe == "raw" else ("met" if np.median(added) <= 150 else "NOT MET")
        print(
            f"  EKF, observe={observe!r:8s} adds    {np.median(added):8.1f}   "
            f"(min {min(added):.1f}, max {max(added):.1f}; target 150 {verdict})"
        )
    env = EstimatedObservation(gym.make("InvertedPendulum-v5"), "ekf", observe="state")
    stepping(env)()
    watch, member = env._watch, env._member
    assert watch.filter is not None
    estimator, belief = watch.filter.estimator, watch.filter._cohorts[0].fusion.belief
    model: Any = estimator.model  # pyright: ignore[reportAttributeAccessIssue]
    batch = model._backend.batch(5)
    x, inputs = watch.divided(member.state()[None])
    u, dt = np.zeros((1, 1)), 2 * model.mjmodel.opt.timestep
    print("  of which")
    for name, call in {
        "Batch.step (5 rows x 2)": lambda: batch.step(nstep=2),
        "Batch.forward (5 rows)": lambda: batch.forward(stage=1),
        "predict, Batch.step included": lambda: estimator.predict(belief, u, 0.0, dt),
        "state and inputs": lambda: watch.divided(member.state()[None]),
        "has the model changed?": member.changes,
        "u of sensors and filter": lambda: watch._following.inputs(inputs),
        "sensors": lambda: watch.suite.read(watch.clocks.tick, 0.0, x, u),
        "info, NEES included": lambda: watch.info(x),
    }.items():
        print(f"    {name:32s} {best(call):8.1f}")


def vector() -> None:
    cores = len(os.sched_getaffinity(0))
    print(f"CartPole-v0, {ROWS} rows, EKF, on {cores} cores, load {os.getloadavg()[0]:.1f}")
    rng = np.random.default_rng(0)
    actions = [rng.uniform(-0.3, 0.3, (ROWS, 1)).astype(np.float32) for _ in range(50)]
    for threads in (1, cores):
        env = gym.make_vec("estbench/CartPole-v0", ROWS, nthread=threads)
        env.reset(seed=0)
        rates, quick = [], []
        for _ in range(REPETITIONS):
            times = []
            for k in range(150):
                began = time.perf_counter()
                env.step(actions[k % 50])
                times.append(time.perf_counter() - began)
            rates.append(ROWS / np.mean(times))
            quick.append(ROWS / np.percentile(times, 10))
        verdict = "met" if np.median(rates) >= 60_000 else "NOT MET"
        print(
            f"  {threads} thread(s): {np.median(rates):8.0f} steps/s (min {min(rates):.0f}, max "
            f"{max(rates):.0f}; undisturbed {np.median(quick):.0f}; target 60000 {verdict})"
        )
        world = env.world  # pyright: ignore[reportAttributeAccessIssue]
        rows = world.filter.estimator.model._backend
        floor = best(lambda: rows.batch(5 * ROWS).step(nstep=1), 100)  # noqa: B023
        floor += best(lambda: rows.batch(ROWS).step(nstep=1), 100)  # noqa: B023
        print(
            f"    bare Batch calls {floor:.0f} µs of {1e6 * ROWS / np.median(quick):.0f} per step"
        )
        env.close()


if __name__ == "__main__":
    logging.getLogger("estbench").setLevel(logging.ERROR)
    assert estbench.envs
    scalar()
    vector()
