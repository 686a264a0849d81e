"""How often the interval of NEES/n is wrong: `python -m benchmarks.calibration`.

Whole experiments on linear-Gaussian models, where the Kalman filter is exact (false alarms), and
with a filter that is told half or twice the true Q (power). `benchmarks.verdict` is of the verdict.
"""

import argparse
import time

from estbench.analysis.calibration import calibrate, oscillator, sample, vehicle
from estbench.consistency.intervals import mean_interval
from estbench.tables.columns import Table, tabulate
from estbench.tables.quantity import percent
from estbench.tables.writers import text

RUNS = (5, 10, 20, 50, 100, 200)
MODELS = {
    "oscillator, 50 steps": (oscillator(), 50),
    "oscillator, 5 steps": (oscillator(), 5),
    "vehicle, 50 steps": (vehicle(), 50),
}


def tables(total: int, experiments: int) -> list[Table]:
    """False alarms and power by runs of an experiment.

    Args:
        total: runs simulated for the false alarms.
        experiments: for each figure of power.
    """
    alarms, power = [], []
    for i, (name, (model, steps)) in enumerate(MODELS.items()):
        matched = sample(model, total, steps, seed=1000 * i)
        wrong = {
            scale: sample(model, experiments * max(RUNS), steps, 1000 * i + j, scale)
            for j, scale in ((100, 0.5), (200, 2.0))
        }
        for runs in RUNS:
            ours, student = (
                calibrate(matched, runs),
                calibrate(matched, runs, interval=mean_interval),
            )
            alarms.append(
                (
                    name, str(runs), str(ours.experiments), percent(ours.refused),
                    f"{ours.above:.1%}", f"{ours.below:.1%}",
                    f"{student.refused.value:.1%}", f"{student.above:.1%}", f"{student.below:.1%}",
                )
            )  # fmt: skip
            found = [calibrate(values[: experiments * runs], runs) for values in wrong.values()]
            power.append((name, str(runs), *(percent(c.refused, 0) for c in found)))
    return [
        tabulate(
            "False alarms of the interval of NEES/n of a consistent filter, level 95%",
            ("<model", "runs", "times", "refused", "over-", "cons.",
             "Student's t", "over-", "cons."),
            alarms,
            "5% refused is right, 2.5% each as overconfident and as conservative.",
        ),
        tabulate(
            "Power: share of experiments in which a wrong Q is found out",
            ("<model", "runs", "Q x 0.5", "Q x 2"),
            power,
        ),
    ]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--total", type=int, default=100_000, help="runs for the false alarms")
    parser.add_argument("--experiments", type=int, default=400, help="for each figure of power")
    arguments = parser.parse_args()
    began = time.perf_counter()
    print(text(tables(arguments.total, arguments.experiments)))
    print(f"\n{time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
