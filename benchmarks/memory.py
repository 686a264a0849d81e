"""Memory of a batch and of a long run: `python -m benchmarks.memory` (5 minutes).

Pendulums with `--keep summary`. First the peak of the arrays and objects of a batch (tracemalloc,
without the bound), beside what `held_bytes` estimates. Then the peak of the resident memory and the
CPU time of a process that computes one short and one long run with an EKF, without and with the
bound, and the bytes per step between the two.
"""

import argparse
import os
import subprocess
import sys
import tracemalloc

from estbench.experiment import setup
from estbench.montecarlo import batch
from estbench.robots.library import engine
from estbench.scenario.load import resolve

CASES = (("ekf", 100, 300), ("rts", 100, 300), ("ekf", 1, 3000), ("ekf", 1, 30_000))
"""Estimator, runs and steps of a batch."""
STEP = 0.01
"""Of the pendulum, s."""
SHORT = 2000
"""Steps of the short run: what a process takes before the first."""


def traced(kind: str, runs: int, steps: int) -> tuple[float, float]:
    """Peak of a batch and its estimate, bytes per run and step."""
    given = {"runs": runs, "duration": steps * STEP, "overrides": ["bound=false"]}
    ready = setup.build(resolve("pendulum", [kind], **given))
    with engine():
        # What is made once, as caches and the first import of a module.
        batch.run_batch(setup.build(resolve("pendulum", [kind], runs=1)), [0], "summary")
        tracemalloc.start()
        batch.run_batch(ready, range(runs), "summary")
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    return peak / (runs * steps), batch.held_bytes(ready, "summary", runs) / (runs * steps)


def process(steps: int, bound: bool) -> tuple[float, float]:
    """Peak of resident memory, bytes, and CPU s of a process with one run."""
    command = [
        sys.executable, "-m", "estbench", "run", "pendulum", "-e", "ekf", "--runs", "1",
        "--duration", f"{steps * STEP:g}", "--keep", "summary", "--set", f"bound={bound}".lower(),
    ]  # fmt: skip
    child = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, used = os.wait4(child.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(command)} failed with status {status}")
    unit = 1 if sys.platform == "darwin" else 1024
    return unit * used.ru_maxrss, used.ru_utime + used.ru_stime


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=300_000, help="of the long run")
    args = parser.parse_args()
    print("| | bytes per run and step | estimated |\n|---|---:|---:|")
    for kind, runs, steps in CASES:
        peak, estimate = traced(kind, runs, steps)
        print(f"| `{kind}`, {runs} x {steps:,} | {peak:.0f} | {estimate:.0f} |", flush=True)
    print("\n| one run | steps | MiB | CPU, s | bytes per step |\n|---|---:|---:|---:|---:|")
    for bound in (False, True):
        name, few = "with the bound" if bound else "without", 0.0
        for steps in (SHORT, args.steps):
            peak, spent = process(steps, bound)
            each = f"{(peak - few) / (steps - SHORT):.0f}" if few else ""
            few = peak
            print(f"| {name} | {steps:,} | {peak / 2**20:.0f} | {spent:.0f} | {each} |", flush=True)


if __name__ == "__main__":
    main()
