"""The filter before and after the tuning on runs that the tuning has not seen."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from estbench.consistency import statistics
from estbench.consistency.fields import Record
from estbench.consistency.intervals import Interval, mean_interval, student_quantile
from estbench.consistency.statistics import RMSE, Summary
from estbench.consistency.summary import summarize
from estbench.errors import EstimatorError, Interrupted
from estbench.experiment.setup import build, variant
from estbench.montecarlo import batch, executors
from estbench.montecarlo.dispatch import Progress
from estbench.scenario.schema import Scenario
from estbench.shapes import Array, Float
from estbench.study import compute as computing
from estbench.study import keys
from estbench.study.compute import Outcomes
from estbench.study.evaluation import Outcome
from estbench.tables.cells import cell, plain, value_of
from estbench.tables.columns import Column, Table
from estbench.tables.quantity import number, quantity
from estbench.tuning.parameters import Parameter


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Before and after on the same held-out runs.

    Attributes:
        seed, runs: of the held-out runs.
        names, units: of the coordinates.
        before, after: summaries.
        likelihood: paired difference after - before of the log-likelihood per run.
        rmse: paired ratio after/before of each coordinate's RMSE, a geometric mean over runs.
        shortfall: of the log-likelihood per run, tuning runs - held-out runs, after the tuning.
    """

    seed: int
    runs: int
    names: tuple[str, ...]
    units: tuple[str, ...]
    before: Summary
    after: Summary
    likelihood: Interval
    rmse: tuple[Interval, ...]
    shortfall: Interval

    @property
    def overfitted(self) -> bool:
        """Whether the held-out likelihood falls short of the tuning's by more than its interval."""
        return self.shortfall.low > 0

    def head(self, level: float) -> str:
        """See `result.Proof`."""
        return (
            f"held-out: {self.runs} runs, seed {self.seed}; change of the log-likelihood per run "
            f"and ratios of RMSE are paired, with the {level:.0%} interval across runs"
        )

    def tables(self) -> list[Table]:
        """The statistics of runs, then RMSE per coordinate."""
        pair = (("before", self.before), ("after", self.after))
        columns: list[tuple[Column, ...]] = [
            (Column("verdict", tuple(str(s.verdict) for _, s in pair), "left"),)
        ]
        for s in statistics.shown("run"):
            if s.form != "number":
                cells = tuple(cell(s, value_of(x, s), s.places["run"]) for _, x in pair)
                columns.append((Column(s.heading_in("run"), cells, narrow=s.narrow),))
        columns.append((Column("log-lik. change", ("", quantity(self.likelihood))),))
        first = Table((Column("", tuple(name for name, _ in pair), "left"),), tuple(columns))
        rmse = [tuple(number(i.value) for i in value_of(x, RMSE)) for _, x in pair]
        second = Table(
            (Column("coordinate", self.names, "left"), Column("unit", self.units, "left")),
            (
                (Column("RMSE before", rmse[0]),), (Column("after", rmse[1]),),
                (Column("after/before", tuple(quantity(i) for i in self.rmse)),),
            ),
        )  # fmt: skip
        return [first, second]

    def words(self) -> list[str]:
        """Over-fitting."""
        if not self.overfitted:
            return []
        return [
            f"over-fitted: the log-likelihood of held-out runs is {quantity(self.shortfall)} "
            "per run below that of the tuning runs; tune on more runs, or free less"
        ]

    def lines(self) -> list[str]:
        """See `result.Proof`."""
        return [
            f"Held-out ({self.runs} runs, seed {self.seed}): {self.before.verdict} -> "
            f"{self.after.verdict}, NEES/n {quantity(self.before.anees)} -> "
            f"{quantity(self.after.anees)}, log-likelihood per run "
            f"{quantity(self.likelihood)} higher."
        ]

    def to_dict(self) -> dict[str, Any]:
        """See `result.Proof`."""
        return {
            "seed": self.seed, "runs": self.runs,
            "log_likelihood_difference": plain(self.likelihood),
            "rmse_ratio": {n: plain(i) for n, i in zip(self.names, self.rmse)},
            "shortfall": plain(self.shortfall), "overfitted": self.overfitted,
            "verdict": {"before": str(self.before.verdict), "after": str(self.after.verdict)},
            "anees_over_n": {
                "before": plain(self.before.anees), "after": plain(self.after.anees),
            },
        }  # fmt: skip


def compare(
    scenario: Scenario,
    label: str,
    parameters: tuple[Parameter, ...],
    tuned: tuple[float, ...],
    seed: int,
    runs: int,
    tuning: Float[Array, " run"],
    progress: Progress | None = None,
) -> HeldOut:
    """Run the estimator before and after on runs of another seed.

    Args:
        scenario: before the tuning.
        label: of the estimator.
        parameters: the free ones.
        tuned: their values after it.
        seed: of the held-out runs.
        runs: how many.
        tuning: log-likelihood of each tuning run after the tuning.
        progress: called with finished and all runs.
    """
    simulation = scenario.simulation.model_copy(update={"seed": seed, "runs": runs})
    only = {label: scenario.estimators[label]}
    base = build(scenario.model_copy(update={"simulation": simulation, "estimators": only}))
    changes = {p.names: v for p, v in zip(parameters, tuned)}
    pair = [base, variant(base, keys.changed(base.scenario, changes))]
    size = batch.default_batch_size(base, "summary")
    batches = [range(i, min(i + size, runs)) for i in range(0, runs, size)]
    found: dict[int, Outcomes] = {}
    pool = executors.pool("threads", executors.cpu_count())
    wanted = [(0, i) for i in range(len(batches))]
    errors, interrupted = computing.compute(
        [pair], batches, wanted, pool, lambda piece, out: found.update({piece[1]: out}), progress
    )
    if interrupted:
        raise Interrupted("interrupted on the held-out runs: go on with --resume")
    for error in errors.values():
        raise error
    was, now = (_joined([found[i][k][label] for i in range(len(batches))], label) for k in (0, 1))
    before, after = (
        summarize(
            label,
            record,
            range(runs),
            base.times,
            scenario.consistency,
            base.space.names,
            tuple(base.channel_spaces),
            scenario.contact,
        )
        for record in (was, now)
    )
    level = scenario.consistency.level
    both = ~(was["diverged"].astype(bool) | now["diverged"].astype(bool))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = 0.5 * np.log(now["mse"][both] / was["mse"][both])
    return HeldOut(
        seed, runs, base.space.names, base.space.units, before, after,
        mean_interval(now["log_likelihood"] - was["log_likelihood"], level),
        tuple(mean_interval(column, level).exponential() for column in ratio.T),
        welch(tuning, now["log_likelihood"], level),
    )  # fmt: skip


def _joined(parts: Sequence[Outcome], label: str) -> Record:
    """The record over all batches.

    Raises:
        EstimatorError: the estimator failed in one of them.
    """
    records = []
    for part in parts:
        if isinstance(part, str):
            raise EstimatorError(f"{label} fails on the held-out runs: {part}")
        records.append(part)
    return {name: np.concatenate([r[name] for r in records]) for name in records[0]}


def welch(a: Float[Array, " run"], b: Float[Array, " run"], level: float) -> Interval:
    """Difference of the means of two independent samples, with Welch's interval (1947)."""
    a, b = a[np.isfinite(a)], b[np.isfinite(b)]
    if min(len(a), len(b)) < 2:
        return Interval(float("nan"), -np.inf, np.inf)
    va, vb = a.var(ddof=1) / len(a), b.var(ddof=1) / len(b)
    dof = (va + vb) ** 2 / (va**2 / (len(a) - 1) + vb**2 / (len(b) - 1)) if va + vb else 1.0
    half = float(student_quantile(level, dof) * np.sqrt(va + vb))
    value = float(a.mean() - b.mean())
    return Interval(value, value - half, value + half)
