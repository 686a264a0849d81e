"""Every estimator on the pendulum and the cart-pole: `python -m benchmarks.estimators`.

Prints results/estimators.md. Each robot's table is what `estbench run ROBOT -e NAME -e NAME ...
--runs N` says with all names of `estbench list`, on the same truth and measurements.
"""

import argparse
import sys

from estbench.estimators.names import BUILTIN
from estbench.montecarlo import run as experiment
from estbench.montecarlo.results import Results
from estbench.tables.quantity import quantity

ROBOTS = ("pendulum", "cartpole")


def table(results: Results) -> list[str]:
    """Lines of a Markdown table: verdict, NEES/n, RMSE of each coordinate, cost."""
    columns = ["estimator", "verdict", "NEES/n", "diverged"]
    columns += [f"{name} ({unit})" for name, unit in zip(results.names, results.units)]
    columns += ["µs/step"]
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    for s in results.summaries:
        cells = [f"`{s.label}`", str(s.verdict), quantity(s.anees), f"{s.diverged:.0%}"]
        cells += [f"{rmse.value:.3g}" for rmse in s.rmse]
        cells += [f"{s.cost:.0f}"]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--duration", type=float, default=5.0, help="s")
    parser.add_argument("--only", nargs="*", default=list(BUILTIN), help="estimators")
    args = parser.parse_args()
    print("# Every estimator on two robots")
    print(
        f"`python -m benchmarks.estimators > results/estimators.md`: {args.runs} runs of "
        f"{args.duration:g} s, seed 0, every setting at its default; RMSE over time and the runs "
        "that did not diverge; cost is of one core. See "
        "[docs/estimators.md](../docs/estimators.md)."
    )
    for robot in ROBOTS:
        print(f"\n## {robot}", flush=True)
        results = experiment.run(
            robot, args.only, runs=args.runs, duration=args.duration, keep="summary",
            progress=lambda done, total: print(f"{done}/{total}", file=sys.stderr),
        )  # fmt: skip
        print("\n".join(table(results)), flush=True)


if __name__ == "__main__":
    main()
