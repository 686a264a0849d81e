"""Calibration and power of the whole verdict: `python -m benchmarks.verdict`.

Whole experiments on linear-Gaussian models: a matched Kalman filter (false alarms, with phases of
contact that the true state decides), one with a wrong Q, and each of the faults of
`estbench.analysis.faults` (power). Level 95%. Before them estimators that an interval of NEES/n
alone takes for consistent (`--only examples`): the pendulum with Q x 1e6, three faults, and a P
that is 20% too small over runs so short that NEES/n has a standard deviation of 0.6.
"""

import argparse
import time
from collections import Counter
from dataclasses import replace

from estbench.analysis.calibration import observed, vehicle
from estbench.analysis.faults import FAULTS
from estbench.analysis.trials import experiments, in_contact, reduced, simulate
from estbench.consistency.fields import Record
from estbench.consistency.intervals import positive_mean_interval, wilson
from estbench.consistency.verdict import Verdict, judge
from estbench.montecarlo.run import run
from estbench.tables.columns import Table, tabulate
from estbench.tables.quantity import percent
from estbench.tables.writers import text

RUNS = (20, 50, 200)
STEPS = 50
MODELS = {"oscillator": observed(), "vehicle": vehicle()}
SCALES = (0.5, 2.0, 100.0)
NOT_REFUSED = (Verdict.CONSISTENT, Verdict.UNDECIDED)


def verdicts(record: Record, runs: int, tolerance: float = 0.1) -> Counter[Verdict]:
    """How many experiments get each verdict."""
    return Counter(judge(part, tolerance=tolerance).verdict for part in experiments(record, runs))


def shares(found: Counter[Verdict]) -> tuple[str, str, str]:
    """Shares of refused (with Wilson's interval), undecided and consistent experiments."""
    total = found.total()
    refused = total - sum(found[v] for v in NOT_REFUSED)
    undecided, consistent = (
        f"{found[v] / total:.0%}" for v in (Verdict.UNDECIDED, Verdict.CONSISTENT)
    )
    return percent(wilson(refused, total)), undecided, consistent


def alarms(total: int) -> Table:
    """What a matched filter is called, by runs of an experiment and tolerance."""
    rows = []
    for i, (name, model) in enumerate(MODELS.items()):
        record = reduced(in_contact(simulate(model, total, STEPS, seed=100 + i)))
        for runs in RUNS:
            for tolerance in (0.0, 0.1):
                found = verdicts(record, runs, tolerance)
                rows.append((name, str(runs), f"{tolerance:g}", str(found.total()), *shares(found)))
    headings = ("<model", "runs", "tolerance", "experiments", "refused", "undecided", "consistent")
    return tabulate("A matched filter", headings, rows)


def power(count: int) -> Table:
    """What filters that are not consistent are called.

    Args:
        count: experiments for each figure.
    """
    model, rows = MODELS["oscillator"], []
    for runs in (50, 200):
        matched = simulate(model, runs * count, STEPS, seed=200 + runs)
        for scale in SCALES:
            record = reduced(simulate(model, runs * count, STEPS, 300 + runs, scale))
            found = verdicts(record, runs)
            word, times = found.most_common(1)[0]
            row = f"Q x {scale:g}", f"{word} {times / count:.0%}", str(runs), *shares(found)
            rows.append(row)
        for name, fault in FAULTS.items():
            found = verdicts(reduced(fault.make(matched, runs)), runs)
            word, times = found.most_common(1)[0]
            rows.append((name, f"{word} {times / count:.0%}", str(runs), *shares(found)))
    headings = ("<filter", "<most often", "runs", "refused", "undecided", "consistent")
    return tabulate("Filters that are not consistent, tolerance 0.1", headings, rows)


def said(found: Counter[Verdict]) -> str:
    """All words, with their shares."""
    return ", ".join(f"{word} {times / found.total():.0%}" for word, times in found.most_common())


def by_nees(record: Record, runs: int) -> str:
    """Share of the experiments whose interval of NEES/n contains 1 within the tolerance."""
    found = [positive_mean_interval(p["anees"]) for p in experiments(record, runs)]
    inside = sum(i.low <= 1.1 and i.high >= 0.9 for i in found)
    return percent(wilson(inside, len(found)))


def examples(count: int) -> Table:
    """Four estimators that NEES/n alone takes for consistent.

    Args:
        count: experiments for each figure.
    """
    one = run("pendulum", ["ekf"], overrides=["filter.process_noise_scale=1e6"])["ekf"]
    i = one.anees
    rows = [("pendulum, Q x 1e6", str(one.runs), f"{i.low:.3f} to {i.high:.3f}", one.reason)]
    model = MODELS["oscillator"]
    for runs in (50, 200):
        matched = simulate(model, runs * count, STEPS, seed=200 + runs)
        for name in ("alternating", "hidden", "biased"):
            record = reduced(FAULTS[name].make(matched, runs))
            row = name, str(runs), by_nees(record, runs), said(verdicts(record, runs))
            rows.append(row)
        short = simulate(model, runs * count, 9, seed=400 + runs)
        record = reduced(replace(short, scale=short.scale / 1.2))
        name = f"P 20% too small, NEES/n of a run ± {record['anees'].std():.2f}"
        rows.append((name, str(runs), by_nees(record, runs), said(verdicts(record, runs))))
    headings = "<estimator", "runs", "not refuted by NEES/n alone", "<verdict"
    return tabulate("Estimators that NEES/n alone takes for consistent", headings, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--total", type=int, default=40_000, help="runs for the false alarms")
    parser.add_argument("--experiments", type=int, default=100, help="for each figure of power")
    groups = ("examples", "alarms", "power")
    parser.add_argument("--only", nargs="+", choices=groups, default=groups)
    arguments = parser.parse_args()
    began = time.perf_counter()
    make = {
        "examples": lambda: examples(arguments.experiments),
        "alarms": lambda: alarms(arguments.total),
        "power": lambda: power(arguments.experiments),
    }
    print(text([make[group]() for group in arguments.only]))
    print(f"\n{time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
