"""What the stopping rules do to intervals and false alarms: `python -m benchmarks.stopping`.

`--only coverage`: NEES/n of independent runs, gamma or lognormal of mean 1, or the normal logarithm
of a ratio of RMSE, runs added until the interval has the wanted half-width; how often the interval
covers the mean, beside an experiment of that many runs that was fixed before. `--only alarms`:
whole verdicts on matched Kalman filters, at the last run and where `--until-decided` ends. The
looks are those of `estbench.montecarlo.stopping`.
"""

import argparse
from collections import Counter

import numpy as np

from benchmarks.verdict import MODELS, NOT_REFUSED, STEPS
from estbench.analysis.trials import experiments, in_contact, reduced, simulate
from estbench.consistency.intervals import positive_mean_bounds, student_quantile, wilson
from estbench.consistency.verdict import Verdict, judge
from estbench.montecarlo.stopping import BATCH, looks
from estbench.shapes import Array
from estbench.tables.columns import Table, tabulate
from estbench.tables.quantity import percent
from estbench.tables.writers import text

SPREADS = (0.1, 0.3, 0.6, 1.0)
"""Standard deviations across runs."""
PRECISIONS = (0.05, 0.02)
CHUNK = 2_000_000
"""Numbers that are drawn at once."""
MOST = 400
"""Runs of an experiment of `alarms`."""


def drawn(kind: str, spread: float, shape: tuple[int, int], rng: np.random.Generator) -> Array:
    """Values of mean 1 and a standard deviation; those of `gamma` and `lognormal` are positive."""
    if kind == "normal":
        return rng.normal(1.0, spread, shape)
    if kind == "gamma":
        return rng.gamma(spread**-2, spread**2, shape)
    variance = np.log1p(spread**2)
    return rng.lognormal(-variance / 2, np.sqrt(variance), shape)


def ends(kind: str, mean: Array, variance: Array, n: Array) -> tuple[Array, Array]:
    """The interval of NEES/n, or for `normal` that of a difference of scores."""
    if kind == "normal":
        half = np.asarray(student_quantile(0.95, n - 1) * np.sqrt(variance / n))
        return mean - half, mean + half
    low, high = positive_mean_bounds(mean, variance, n)
    return np.asarray(low), high


def stopped(kind: str, spread: float, precision: float, total: int, seed: int) -> tuple[Array, ...]:
    """Whether each experiment's interval covers 1, its runs, and whether a fixed count covers."""
    rng = np.random.default_rng(seed)
    most = max(4 * BATCH, int(3 * (1.96 * spread / precision) ** 2))
    counts = np.array(list(looks(BATCH, most)))
    fixed = int(np.searchsorted(counts, (1.96 * spread / precision) ** 2))
    found = []
    for rows in np.array_split(np.arange(total), -(-total * most // CHUNK)):
        x = drawn(kind, spread, (len(rows), most), rng)
        n = counts.astype(float)
        mean = np.cumsum(x, axis=1)[:, counts - 1] / n
        square = np.cumsum(x**2, axis=1)[:, counts - 1] / n
        low, high = ends(kind, mean, (square - mean**2) * n / (n - 1), n)
        narrow = (high - low) / 2 <= precision
        at = np.where(narrow.any(axis=1), narrow.argmax(axis=1), len(counts) - 1)
        inside = (low <= 1) & (high >= 1)
        row = np.arange(len(rows))
        found.append((inside[row, at], counts[at], inside[:, min(fixed, len(counts) - 1)]))
    return tuple(np.concatenate(column) for column in zip(*found))


def coverage(total: int) -> Table:
    """Coverage of the 95% interval at the end, by the distribution of NEES/n across runs."""
    rows = []
    for i, kind in enumerate(("gamma", "lognormal", "normal")):
        for j, spread in enumerate(SPREADS):
            for k, precision in enumerate(PRECISIONS):
                inside, runs, fixed = stopped(kind, spread, precision, total, 100 * i + 10 * j + k)
                rows.append((
                    kind, f"{spread:g}", f"{precision:g}", f"{np.median(runs):.0f}",
                    percent(wilson(int(inside.sum()), total)),
                    percent(wilson(int(fixed.sum()), total)),
                ))  # fmt: skip
    headings = ("<distribution", "spread", "precision", "runs", "covered, rule", "covered, fixed")
    return tabulate("The 95% interval where the rule ends", headings, rows)


def alarms(total: int) -> Table:
    """What a matched filter is called where a rule or the last run ends the experiment."""
    rows = []
    for i, (name, model) in enumerate(MODELS.items()):
        record = reduced(in_contact(simulate(model, total * MOST, STEPS, seed=100 + i)))
        for tolerance in (0.0, 0.1):
            ends: Counter[Verdict] = Counter()
            fixed: Counter[Verdict] = Counter()
            runs = []
            for part in experiments(record, MOST):
                for count in looks(BATCH, MOST):
                    few = {key: values[:count] for key, values in part.items()}
                    verdict = judge(few, tolerance=tolerance).verdict
                    if verdict is not Verdict.UNDECIDED:
                        break
                runs.append(count)
                ends[verdict] += 1
                fixed[judge(part, tolerance=tolerance).verdict] += 1
            for what, found, typical in (
                ("until decided", ends, np.median(runs)), (f"{MOST} runs", fixed, MOST),
            ):  # fmt: skip
                refused = total - sum(found[v] for v in NOT_REFUSED)
                rows.append((
                    name, f"{tolerance:g}", what, f"{typical:.0f}",
                    percent(wilson(refused, total)),
                    f"{found[Verdict.UNDECIDED] / total:.0%}",
                    f"{found[Verdict.CONSISTENT] / total:.0%}",
                ))  # fmt: skip
    headings = ("<model", "tolerance", "<end", "runs", "refused", "undecided", "consistent")
    return tabulate(f"A matched filter, at most {MOST} runs", headings, rows)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", choices=["coverage", "alarms"], help="one of the tables")
    parser.add_argument("--experiments", type=int, default=2000, help="of each row of coverage")
    parser.add_argument("--verdicts", type=int, default=400, help="experiments of each of alarms")
    args = parser.parse_args()
    if args.only != "alarms":
        print(text([coverage(args.experiments)]))
    if args.only != "coverage":
        print(text([alarms(args.verdicts)]))


if __name__ == "__main__":
    main()
