"""All cores over one, on every bundled robot: `python -m benchmarks.cores` (10 to 20 minutes).

For each scenario and filter: the share of one core's time under the interpreter's lock, and a batch
that takes one core `--seconds`, computed by one thread and with `--executor auto` on all cores, in
turn; with the start of the spawned processes, which are dismissed before, and with those that are
kept. `--model` computes nothing but the shares, and prints what the queue of
`montecarlo/scaling.py` makes of them for up to 64 threads and processes.
"""

import argparse
import os
import statistics
import time

from benchmarks.matched import EXAMPLES
from estbench.experiment import setup
from estbench.experiment.prepared import Setup
from estbench.montecarlo import batch, executors, forecast, scaling, team
from estbench.montecarlo import run as experiment
from estbench.scenario.files import bundled
from estbench.scenario.load import load

BATCHES = 16
"""Of one measurement at least: fewer do not divide evenly."""
CORES = (2, 4, 8, 16, 64)


def prepared(path: str, kind: str, runs: int, seconds: float | None = None) -> Setup:
    """A scenario with one filter."""
    end = [] if seconds is None else [f"simulation.duration={seconds:g}"]
    resolved = load(path, ["bound=false", *end])
    return setup.build(experiment.resolve(resolved, [kind], runs=runs))


def sized(path: str, kind: str, seconds: float) -> Setup:
    """A batch that takes one core so many seconds: more runs, or a shorter duration."""
    whole = prepared(path, kind, 4000)
    step = measured(whole).step
    duration = whole.scenario.simulation.duration
    steps = len(whole.instants)
    runs = int(seconds / (step * steps))
    least = BATCHES * 100
    if runs >= least:
        return prepared(path, kind, runs)
    return prepared(path, kind, least, max(10 * duration / steps, duration * runs / least))


def measured(ready: Setup) -> forecast.Forecast:
    """What one core takes: the median of three forecasts by the share under the lock."""
    size = batch.default_batch_size(ready, "summary")
    runs = ready.scenario.simulation.runs
    found = [forecast.forecast(ready, runs, size, "summary", 1) for _ in range(3)]
    return sorted(found, key=lambda each: each.locked or 0.0)[1]


def wall(ready: Setup, workers: int) -> float:
    """Seconds of all runs."""
    began = time.perf_counter()
    experiment.run(ready.scenario, keep="summary", workers=workers, executor="auto")
    return time.perf_counter() - began


def speedups(ready: Setup, workers: int) -> tuple[float, float, float]:
    """Seconds of one core; its ratio to all cores that have to start, and that stand."""
    one = wall(ready, 1)
    if team._kept:
        team.dismiss(team._kept[0])
    started = wall(ready, workers)
    kept = wall(ready, workers)
    return one, one / started, one / kept


def shares(paths: list[str], kinds: list[str]) -> None:
    """The shares, and the model's speed of threads."""
    print("| | share | " + " | ".join(f"{k} threads" for k in CORES) + " |")
    print("|---|---:|" + len(CORES) * "---:|")
    for path in paths:
        for kind in kinds:
            ready = prepared(path, kind, 4000)
            share = measured(ready).locked or 0.0
            cells = (f"{scaling.thread_speed(share, k):.2f}" for k in CORES)
            print(f"| {kind} on {ready.scenario.name} (n = {ready.space.n}) | {share:.2f} | "
                  f"{' | '.join(cells)} |", flush=True)  # fmt: skip
    print("\n| one core, s | " + " | ".join(f"{k} processes" for k in CORES) + " |")
    print("|---:|" + len(CORES) * "---:|")
    for work in (10, 60, 600):
        cells = (work / ((work + (k - 1) * scaling.START) / k) for k in CORES)
        print(f"| {work} | {' | '.join(f'{x:.2f}' for x in cells)} |")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", help="scenarios; default all that are bundled")
    parser.add_argument("--estimators", nargs="*", default=["ekf", "ukf"])
    parser.add_argument("--seconds", type=float, default=10.0, help="of one core")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--workers", type=int, default=executors.cpu_count())
    parser.add_argument("--model", action="store_true", help="only the shares and the model")
    args = parser.parse_args()
    paths = args.only or [*bundled(), str(EXAMPLES / "gymnasium" / "ant.toml")]
    if args.model:
        shares(paths, args.estimators)
        return
    print(f"{executors.cpu_count()} cores, {args.workers} workers; median of {args.repeat}")
    print("| | one core, s | all / one, started | all / one, kept | load before |")
    print("|---|---:|---:|---:|---:|")
    for path in paths:
        for kind in args.estimators:
            ready = sized(path, kind, args.seconds)
            before = os.getloadavg()[0]
            found = [speedups(ready, args.workers) for _ in range(args.repeat)]
            one, started, kept = (statistics.median(column) for column in zip(*found))
            print(f"| {kind} on {ready.scenario.name} | {one:.1f} | {started:.2f} | {kept:.2f} | "
                  f"{before:.1f} |", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
