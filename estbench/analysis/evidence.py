"""What a store says about one estimator, in the form that the rules of `estbench explain` ask for.

Means across runs have intervals that hold for all columns of a variable at once (Bonferroni).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import stats

from estbench.analysis.stored import Stored
from estbench.consistency.blocks import Block, blocks
from estbench.consistency.fields import Record
from estbench.consistency.hypotheses import Hypothesis, Kind
from estbench.consistency.intervals import Interval, mean_interval, positive_mean_interval
from estbench.consistency.statistics import Summary
from estbench.errors import AnalysisError
from estbench.inference.lags import correlation
from estbench.scenario.schema import Scenario
from estbench.shapes import Array, Float

NEEDED = ("nees_by_block", "scaled_error", "scaled_square", "channel_nis", "lags", "lag_terms")
"""Variables that stores of earlier versions lack."""
RARE = 1e-3
"""Probability beyond which a NIS counts as an outlier."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """The record of one estimator over the runs that did not diverge.

    Attributes:
        label: of the estimator.
        scenario: as it was run.
        summary: of the estimator.
        names: of the coordinates.
        channels: names of the channels.
        spans: the blocks of time.
        record: the variables of the runs that did not diverge.
        rare: share of the updates whose NIS is beyond the 1 - `RARE` quantile, over `RARE`, and the
            median of NIS over that of chi-square; None without traces.
        components: names of the components of a reading, of a log.
    """

    label: str
    scenario: Scenario
    summary: Summary
    names: tuple[str, ...]
    channels: tuple[str, ...]
    spans: tuple[Block, ...]
    record: Record
    rare: tuple[float, float] | None = None
    components: tuple[str, ...] = ()

    @property
    def runs(self) -> int:
        """Runs that did not diverge."""
        return len(self.record["anees"])

    def refuted(self, *kinds: Kind) -> list[Hypothesis]:
        """What the verdict refutes, of some kinds; without a kind, all of it."""
        return [h for h in self.summary.judgement.refuted if not kinds or h.kind in kinds]

    @cached_property
    def nees(self) -> Interval:
        """NEES/n."""
        return self.ratio(self.record["anees"])[0]

    @cached_property
    def nis(self) -> Interval:
        """NIS/m."""
        return self.ratio(self.record["anis"])[0]

    @cached_property
    def lag_one(self) -> Interval:
        """Lag-one correlation of the whitened innovations."""
        return self.mean(self.record["lag_one"])[0]

    @cached_property
    def persistence(self) -> float:
        """Mean correlation of the innovations at lags 6 to 10, over that at lag one."""
        rho = correlation(self.record["lags"].sum(axis=0), self.record["lag_terms"].sum(axis=0))
        return float(np.mean(rho[6:]) / rho[1])

    def ratio(self, values: Float[Array, " run *any"]) -> list[Interval]:
        """Means of positive values, with intervals that hold for all columns at once."""
        return self._intervals(values, positive_mean_interval)

    def mean(self, values: Float[Array, " run *any"]) -> list[Interval]:
        """Means of any values, likewise."""
        return self._intervals(values, mean_interval)

    def _intervals(
        self, values: Array, interval: Callable[[Array, float], Interval]
    ) -> list[Interval]:
        columns = values.reshape(len(values), math.prod(values.shape[1:])).T
        level = 1 - (1 - self.scenario.consistency.level) / len(columns)
        return [interval(column[np.isfinite(column)], level) for column in columns]


def gather(stored: Stored, label: str) -> Evidence:
    """The evidence about one estimator.

    Raises:
        AnalysisError: no such estimator, or a store of an earlier version.
    """
    if label not in stored.records:
        known = ", ".join(stored.records)
        raise AnalysisError(f"no estimator '{label}' in {stored.folder}; it has {known}")
    record = stored.samples[label]
    missing = [name for name in NEEDED if name not in record]
    if missing:
        raise AnalysisError(
            f"{stored.folder} lacks {', '.join(missing)}: it is of an earlier version of estbench; "
            "run the scenario again"
        )
    good = ~record["diverged"].astype(bool)
    per_run = {name: value[good] for name, value in record.items() if len(value) == len(good)}
    return Evidence(
        label=label,
        scenario=stored.scenario,
        summary=stored.summaries[label],
        names=stored.names,
        channels=tuple(map(str, np.asarray(stored.tree["channel"]))),
        spans=blocks(stored.times, stored.scenario.consistency.burn_in),
        record=per_run,
        rare=_rare(stored, label),
        components=tuple(map(str, np.asarray(stored.tree["reading"]))) if stored.log else (),
    )


def _rare(stored: Stored, label: str) -> tuple[float, float] | None:
    """The tail and the middle of NIS against those of chi-square."""
    group, good = stored.tree[label], ~stored.records[label]["diverged"].astype(bool)
    if "nis" not in group or not good.any():
        return None
    done = np.isin(np.asarray(stored.tree["run"]), stored.runs)
    nis, dof = (np.asarray(group[name])[done][good] for name in ("nis", "dof"))
    came = dof > 0
    level = stats.chi2.cdf(nis[came], dof[came])
    return float(np.mean(level > 1 - RARE) / RARE), float(np.median(level))
