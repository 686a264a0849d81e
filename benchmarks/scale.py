"""Memory and cost of very many runs: `python -m benchmarks.scale`.

Each experiment is a fresh process, whose children count. Its peak of resident memory is sampled (a
sum over the processes, shared pages counted in each, so an upper bound). Small and large
experiments alternate, and the median of their ratios is taken: what else the machine does then hits
both.
"""

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

CHILD = """
import json, resource, sys, time
from estbench.montecarlo import run as experiment
arguments, out = json.loads(sys.argv[1]), sys.argv[2]
experiment.run("pendulum", ["ekf"], runs=10, duration=0.1, workers=1)  # what is paid once
wall, cpu = time.perf_counter(), time.process_time()
if __name__ == "__main__":
    experiment.run("pendulum", ["ekf"], out=out, **arguments)
children = resource.getrusage(resource.RUSAGE_CHILDREN)
cpu = time.process_time() - cpu + children.ru_utime + children.ru_stime
print(json.dumps({"wall": time.perf_counter() - wall, "cpu": cpu}))
"""
STEP = 0.01
"""Of the pendulum, s."""


@dataclass(frozen=True)
class Cost:
    """What one experiment took.

    Attributes:
        runs: how many.
        wall, cpu: s, of the experiment, without starting Python; CPU of all processes.
        peak: most resident memory of all its processes at once, bytes.
    """

    runs: int
    wall: float
    cpu: float
    peak: int


def measure(runs: int, steps: int, keep: str, executor: str, workers: int) -> Cost:
    """Run one experiment in a process of its own."""
    arguments = {
        "runs": runs, "duration": steps * STEP, "keep": keep, "executor": executor,
        "workers": workers,
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        # A file, not -c: a spawned child imports its parent's main module.
        script = Path(folder) / "child.py"
        script.write_text(CHILD, encoding="utf-8")
        process = subprocess.Popen(
            [sys.executable, script, json.dumps(arguments), f"{folder}/x"], stdout=subprocess.PIPE
        )
        peak = 0
        while process.poll() is None:
            peak = max(peak, sum(map(resident, family(process.pid))))
            time.sleep(0.1)
        assert process.stdout is not None
        if process.returncode:
            raise SystemExit(process.returncode)
        taken = json.loads(process.stdout.read())
    return Cost(runs, taken["wall"], taken["cpu"], peak)


def family(pid: int) -> list[int]:
    """A process and its descendants."""
    try:
        tasks = Path(f"/proc/{pid}/task").iterdir()
        found = [int(c) for t in tasks for c in (t / "children").read_text().split()]
    except OSError:  # it has gone
        return []
    return [pid, *(p for child in found for p in family(child))]


def resident(pid: int) -> int:
    """Resident memory of a process, bytes."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text(encoding="utf-8").splitlines()
    except OSError:
        return 0
    return next((1024 * int(x.split()[1]) for x in lines if x.startswith("VmRSS")), 0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=100_000, help="of the large experiment")
    parser.add_argument("--base", type=int, default=2_000, help="runs to compare with")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--repeat", type=int, default=3, help="pairs of experiments")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--executor", default="threads", choices=("threads", "processes"))
    a = parser.parse_args()
    where = f"pendulum, EKF, {a.steps} steps, {a.workers} {a.executor}"
    print(f"{where}; {a.repeat} pairs of {a.base} and {a.runs} runs, keep=summary")

    def cost(runs: int, keep: str) -> Cost:
        found = measure(runs, a.steps, keep, a.executor, a.workers)
        wall, cpu = (1e6 * x / (runs * a.steps) for x in (found.wall, found.cpu))
        print(f"  {runs:>7} {keep:<8}  {wall:6.2f} µs wall, {cpu:6.2f} µs CPU per run and step, "
              f"peak {found.peak / 2**20:5.0f} MiB", flush=True)  # fmt: skip
        return found

    def ratio(pairs: list[tuple[Cost, Cost]]) -> str:
        """Median of the costs per run of the second over the first, by CPU and by wall time."""
        return ", ".join(
            f"{statistics.median([y / x for x, y in of]):.3f} by {name}"
            for name, of in (
                ("CPU", [(x.cpu / x.runs, y.cpu / y.runs) for x, y in pairs]),
                ("wall", [(x.wall / x.runs, y.wall / y.runs) for x, y in pairs]),
            )
        )

    large = [(cost(a.base, "summary"), cost(a.runs, "summary")) for _ in range(a.repeat)]
    traces = [(cost(a.base, "summary"), cost(a.base, "diagonal")) for _ in range(2 * a.repeat)]
    print(f"cost per run, {a.runs} over {a.base} runs: {ratio(large)}   (wanted: at most 1.15)")
    print(f"cost per run, diagonal over summary: {ratio(traces)}   (wanted: at most 1.15)")
    peak = max(y.peak for _, y in large) / 2**30
    print(f"peak resident memory of {a.runs} runs: {peak:.2f} GiB   (wanted: below 2)")


if __name__ == "__main__":
    main()
