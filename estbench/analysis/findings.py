"""Statistics of one estimator of a store beyond its summary, as `estbench compare` shows them."""

from dataclasses import dataclass

import numpy as np

from estbench.analysis.stored import Stored
from estbench.consistency import coverage, credibility, intervals, phases, whiteness
from estbench.consistency.fields import Record
from estbench.consistency.intervals import Interval, positive_mean_interval
from estbench.consistency.statistics import Summary
from estbench.shapes import Array

TRIM = 0.1
"""Share left out at each end of a trimmed mean."""


@dataclass(frozen=True, eq=False)
class Accuracy:
    """RMSE of the norm of the error in all coordinates of one unit.

    Attributes:
        unit: of the coordinates.
        names: of the coordinates.
        mean: root of the mean over the runs that did not diverge.
        trimmed, median: over all runs; a diverged run counts as infinite.
        sigma: root of the mean sum of the variances that the filter reports.
        coverage: shares within 1, 2, 3σ, or None if the store has none.
        needed: count of runs for the wanted relative half-width of the mean.
    """

    unit: str
    names: tuple[str, ...]
    mean: Interval
    trimmed: Interval
    median: Interval
    sigma: float
    coverage: coverage.Coverage | None
    needed: int | None


@dataclass(frozen=True, eq=False)
class Findings:
    """One estimator of one store.

    Attributes:
        key: its name in the comparison, unique.
        label: its name in the store.
        stored: the store.
        summary: verdict and statistics.
        accuracy: one per unit.
        coverage: one per coordinate, or None if the store has none.
        phases: statistics by phase of contact; empty without contacts.
        anees_trimmed, anees_median: NEES/n over all runs.
        anees_needed: count of runs for the wanted half-width of ANEES/n.
        whiteness: of the innovations, or None.
        nci, inclination, nci_expected: means over the settled steps, dB; None without traces.
    """

    key: str
    label: str
    stored: Stored
    summary: Summary
    accuracy: tuple[Accuracy, ...]
    coverage: tuple[coverage.Coverage, ...] | None
    phases: tuple[phases.InPhase, ...]
    anees_trimmed: Interval
    anees_median: Interval
    anees_needed: int | None
    whiteness: whiteness.Whiteness | None
    nci: float | None
    inclination: float | None
    nci_expected: float | None

    @property
    def record(self) -> Record:
        """Arrays of the finished runs, or of the parts of a log."""
        return self.stored.samples[self.label]


def find(stored: Stored, label: str, key: str, precision: float) -> Findings:
    """All findings about one estimator of a store.

    Args:
        stored: the store.
        label: of the estimator.
        key: its name in the comparison.
        precision: wanted relative half-width of RMSE, and half-width of ANEES/n.
    """
    record, level = stored.samples[label], stored.scenario.consistency.level
    good = ~record["diverged"].astype(bool)
    inside = inside_shares(record)
    anees = np.where(good, record["anees"], np.inf)
    credible = None
    if stored.traces(label) is not None and good.any():
        credible = credibility.credibility(lambda: stored.traces(label) or ())
    lags = "lags" in record and "lag_terms" in record
    return Findings(
        key=key,
        label=label,
        stored=stored,
        summary=stored.summaries[label],
        accuracy=accuracies(record, stored.names, stored.units, level, precision),
        coverage=None
        if inside is None
        else tuple(coverage.coverage(inside[good, i], level) for i in range(len(stored.names))),
        phases=phases.by_phase(record, stored.units, level),
        anees_trimmed=intervals.trimmed_mean(anees, TRIM, level),
        anees_median=intervals.median(anees, level),
        anees_needed=intervals.runs_needed(record["anees"][good], precision, level),
        whiteness=whiteness.whiteness(record["lags"][good], record["lag_terms"][good], level)
        if lags
        else None,
        nci=None if credible is None else float(credible.nci.mean()),
        inclination=None if credible is None else float(credible.inclination.mean()),
        nci_expected=None if credible is None else credible.expected,
    )


def accuracies(
    record: Record, names: tuple[str, ...], units: tuple[str, ...], level: float, precision: float
) -> tuple[Accuracy, ...]:
    """The accuracy of an estimator, one entry per unit.

    Args:
        record: as `records.merge` gives it.
        names: of the coordinates `(n,)`.
        units: of the coordinates `(n,)`.
        level: confidence.
        precision: wanted relative half-width of RMSE.
    """
    good = ~record["diverged"].astype(bool)
    inside = inside_shares(record)
    found = []
    for unit in dict.fromkeys(units):
        members = [i for i, u in enumerate(units) if u == unit]
        mse = record["mse"][:, members].sum(axis=1)
        every = np.where(good, mse, np.inf)
        mean = positive_mean_interval(mse[good], level)
        variance = record["variance"][good][:, members].sum(axis=1)
        found.append(
            Accuracy(
                unit=unit,
                names=tuple(names[i] for i in members),
                mean=mean.root(),
                trimmed=intervals.trimmed_mean(every, TRIM, level).root(),
                median=intervals.median(every, level).root(),
                sigma=float(np.sqrt(variance.mean())) if good.any() else np.nan,
                coverage=None
                if inside is None
                else coverage.coverage(inside[good][:, members], level),
                # RMSE to a relative half-width is MSE to twice that.
                needed=intervals.runs_needed(mse[good], 2 * precision * mean.value, level),
            )
        )
    return tuple(found)


def inside_shares(record: Record) -> Array | None:
    """Shares within 1, 2, 3σ `(run, coordinate, 3)`, or None if the record has none."""
    names = [f"inside_{k}" for k in coverage.SIGMAS]
    if not all(name in record for name in names):
        return None
    return np.stack([record[name] for name in names], axis=-1)
