"""What a filter adds to a Gymnasium step: `python -m benchmarks.envs [scalar alone vector]`.

Targets: a wrapped InvertedPendulum-v5 with an EKF adds at most 130 µs a step, the native cart-pole
takes at most 80; the vector CartPole with 256 rows and an EKF does at least 200,000 environment
steps a second on 2 cores; a wrapped HalfCheetah-v5 that has 2 cores for itself does 1.6 times the
steps of one core. The floor beside the vector is the time of its bare `Batch` calls.
"""

import logging
import os
import sys
import time
from collections.abc import Callable
from itertools import cycle
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


def stepping(env: gym.Env, size: float = 0.0) -> Callable[[], None]:
    """A function that steps, resetting where an episode ends outside of what is timed."""
    shape, rng = env.action_space.shape or (), np.random.default_rng(0)
    actions = cycle([(size * rng.uniform(-1, 1, shape)).astype(np.float32) for _ in range(100)])
    env.reset(seed=0)

    def step() -> None:
        _, _, terminated, truncated, _ = env.step(next(actions))
        if terminated or truncated:
            env.reset()

    return step


def wrapped(name: str, estimator: str, **settings: Any) -> EstimatedObservation:
    """A wrapped environment."""
    return EstimatedObservation(gym.make(name), estimator, **settings)


def scalar() -> None:
    bare = stepping(gym.make("InvertedPendulum-v5"))
    print(
        f"InvertedPendulum-v5 (RK4, 2 physics steps per step); µs per step, median of {REPETITIONS}"
    )
    base = float(np.median([best(bare) for _ in range(REPETITIONS)]))
    print(f"  without a wrapper            {base:8.1f}")
    for observe in ("raw", "state", "env"):
        step = stepping(wrapped("InvertedPendulum-v5", "ekf", observe=observe, nthread=1))
        added = [best(step) - base for _ in range(REPETITIONS)]
        verdict = "" if observe == "raw" else ("met" if np.median(added) <= 130 else "NOT MET")
        print(
            f"  EKF, observe={observe!r:8s} adds    {np.median(added):8.1f}   "
            f"(min {min(added):.1f}, max {max(added):.1f}; target 130 {verdict})"
        )
    native = stepping(gym.make("estbench/CartPole-v0", nthread=1))
    took = [best(native) for _ in range(REPETITIONS)]
    print(
        f"CartPole-v0, EKF, takes {np.median(took):.1f} (min {min(took):.1f}, max {max(took):.1f}; "
        f"target 80 {'met' if np.median(took) <= 80 else 'NOT MET'})"
    )
    env = wrapped("InvertedPendulum-v5", "ekf", observe="state", nthread=1)
    stepping(env)()
    watch, member = env._watch, env._member
    assert watch.filter is not None
    estimator, belief = watch.filter.estimator, watch.filter._cohorts[0].fusion.belief
    model: Any = estimator.model  # pyright: ignore[reportAttributeAccessIssue]
    batch = model._backend.batch(5)
    x, inputs = watch.divided(member.state()[None])
    u, dt = np.zeros((1, 1)), 2 * model.mjmodel.opt.timestep
    print("of a step of InvertedPendulum-v5")
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


def alone() -> None:
    """One legged robot: its filter's rows on one thread, and on as many as make it faster."""
    print(f"HalfCheetah-v5, random actions, steps/s; load {os.getloadavg()[0]:.1f}")
    bare = stepping(gym.make("HalfCheetah-v5"), 1.0)
    print(f"  without a wrapper {1e6 / best(bare):8.0f}")
    for name in ("ekf", "ukf"):
        steps = [stepping(wrapped("HalfCheetah-v5", name, nthread=n), 1.0) for n in (1, None)]
        rates = np.array([[rate(step) for step in steps] for _ in range(REPETITIONS)])
        one, shared = np.median(rates, axis=0)
        ratio = np.median(rates[:, 1] / rates[:, 0])
        verdict = "met" if ratio >= 1.6 else "NOT MET"
        print(
            f"  {name} {one:8.0f}  shared {shared:8.0f}  ratio {ratio:.2f} (target 1.6 {verdict})"
        )


def rate(step: Callable[[], None], count: int = 500) -> float:
    """Steps per second."""
    began = time.perf_counter()
    for _ in range(count):
        step()
    return count / (time.perf_counter() - began)


def cartpoles(threads: int) -> gym.vector.VectorEnv:
    """The native vector environment."""
    env = gym.make_vec("estbench/CartPole-v0", ROWS, nthread=threads)
    env.reset(seed=0)
    return env


def step_times(env: gym.vector.VectorEnv, count: int = 150) -> list[float]:
    """Seconds of each of some steps."""
    rng, times = np.random.default_rng(0), []
    actions = [rng.uniform(-0.3, 0.3, (ROWS, 1)).astype(np.float32) for _ in range(50)]
    for k in range(count):
        began = time.perf_counter()
        env.step(actions[k % 50])
        times.append(time.perf_counter() - began)
    return times


def vector() -> None:
    cores = len(os.sched_getaffinity(0))
    print(f"CartPole-v0, {ROWS} rows, EKF, on {cores} cores, load {os.getloadavg()[0]:.1f}")
    for threads in (1, cores):
        env = cartpoles(threads)
        rates, quick = [], []
        for _ in range(REPETITIONS):
            times = step_times(env)
            rates.append(ROWS / np.mean(times))
            quick.append(ROWS / np.percentile(times, 10))
        verdict = "met" if np.median(rates) >= 200_000 else "NOT MET"
        print(
            f"  {threads} thread(s): {np.median(rates):8.0f} steps/s (min {min(rates):.0f}, max "
            f"{max(rates):.0f}; undisturbed {np.median(quick):.0f}; target 200000 {verdict})"
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
    parts = {part.__name__: part for part in (scalar, alone, vector)}
    for chosen in sys.argv[1:] or parts:
        parts[chosen]()
