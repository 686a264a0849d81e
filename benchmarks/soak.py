"""Memory over many steps of a vector environment: `python -m benchmarks.soak`.

Random actions in 256 cart-poles with an EKF; their episodes end and begin anew all the time. Prints
the steps of all rows together, the resident memory and the steps per second ten times, then how
much the memory grew over the last nine tenths.
"""

import argparse
import os
import time
from pathlib import Path

import gymnasium as gym

import estbench.envs  # noqa: F401  (registers the environments)

PAGE = os.sysconf("SC_PAGE_SIZE")


def resident() -> float:
    """Resident memory of this process, MiB (Linux)."""
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * PAGE / 2**20


def main() -> None:
    """Step and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=2_000_000, help="of all rows together")
    parser.add_argument("--rows", type=int, default=256)
    parser.add_argument("--env", default="estbench/CartPole-v0")
    options = parser.parse_args()
    env = gym.make_vec(options.env, options.rows)
    env.reset(seed=0)
    env.action_space.seed(0)
    calls = options.steps // options.rows
    memory, episodes, began = [], 0, time.monotonic()
    for call in range(1, calls + 1):
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        episodes += int((terminated | truncated).sum())
        if call % (calls // 10) == 0:
            memory.append(resident())
            done = call * options.rows
            speed = done / (time.monotonic() - began)
            reached = f"{done:9d} steps, {episodes:7d} episodes"
            print(f"{reached}, {memory[-1]:7.1f} MiB, {speed:.0f} steps/s", flush=True)
    print(f"grown by {memory[-1] - memory[0]:.1f} MiB")


if __name__ == "__main__":
    main()
