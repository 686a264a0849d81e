"""Comparison of all pairs of entries run by run, with the tests of `analysis.comparison`."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import combinations

import numpy as np

from estbench.analysis.comparison import Pair, Paired, compare, paired
from estbench.consistency.multiplicity import holm
from estbench.consistency.scores import score
from estbench.report.sources import Entry
from estbench.shapes import Array

MARGIN = 0.01
"""A relative difference that is too small to matter, as in `estbench compare`."""


@dataclass(frozen=True, eq=False)
class Difference:
    """One entry minus a baseline, over the runs that both have.

    Attributes:
        entry, baseline: keys.
        cost: ratio.
        score: over all coordinates, as in `estbench compare`: ratio of RMSE, Holm's p-values over
            all pairs of entries, and whether the two differ.
        nees: comparison of the runs' NEES/n.
        rmse: comparison of the runs' RMSE, one per coordinate, in its unit.
        p: Wilcoxon's p-values of NEES/n and each RMSE `(1 + n,)`, after Holm's correction over all
            these quantities of all pairs.
    """

    entry: str
    baseline: str
    cost: float
    score: Pair
    nees: Paired
    rmse: tuple[Paired, ...]
    p: Array

    def reversed(self) -> "Difference":
        """The baseline minus the entry."""
        return Difference(
            self.baseline, self.entry, 1 / self.cost if self.cost else np.nan, _turned(self.score),
            _negative(self.nees), tuple(map(_negative, self.rmse)), self.p,
        )  # fmt: skip


def differences(entries: Sequence[Entry]) -> list[Difference]:
    """Each entry minus each other one, over the runs that all sources have; [] without any."""
    if any(entry.source.log for entry in entries) and not _one_log(entries):
        return []
    runs = reduce(np.intersect1d, [entry.source.runs for entry in entries])
    if len(entries) < 2 or not len(runs):
        return []
    level = entries[0].source.level
    values, scores = {}, {}
    for entry in entries:
        record = entry.sample
        rows = np.isin(entry.source.runs, runs) if entry.source.log is None else slice(None)
        lost = record["diverged"].astype(bool)[rows]
        mse, nees = record["mse"][rows], record["anees"][rows]
        scores[entry.key] = score(mse, lost)
        table = np.concatenate([nees[:, None], np.sqrt(mse)], axis=1)
        values[entry.key] = np.where(lost[:, None], np.inf, table)
    pairs, _ = compare(scores, level, MARGIN)
    found = [
        [paired(x, y, level) for x, y in zip(values[a.key].T, values[b.key].T)]
        for a, b in combinations(entries, 2)
    ]
    p = holm([q.wilcoxon for row in found for q in row]).reshape(len(found), -1)
    out = []
    for (a, b), pair, (nees, *rmse), adjusted in zip(
        combinations(entries, 2), pairs, found, p, strict=True
    ):
        cost = a.summary.cost / b.summary.cost if b.summary.cost else np.nan
        one = Difference(a.key, b.key, cost, pair, nees, tuple(rmse), adjusted)
        out += [one, one.reversed()]
    return out


def _one_log(entries: Sequence[Entry]) -> bool:
    """Whether all are of one log with truth, and were given the same readings."""
    logs = [entry.source.log for entry in entries]
    return logs[0] is not None and logs[0]["truth"] and all(log == logs[0] for log in logs)


def _negative(p: Paired) -> Paired:
    return replace(
        p, difference=-p.difference, lost=-p.lost, less=p.more, more=p.less,
        effect=-p.effect,
    )  # fmt: skip


def _turned(pair: Pair) -> Pair:
    return replace(
        pair, a=pair.b, b=pair.a, paired=_negative(pair.paired), ratio=pair.ratio.reciprocal()
    )
