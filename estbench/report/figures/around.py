"""A statistic around an event of contact: averaged over the events of each run, then over runs."""

from dataclasses import dataclass

import numpy as np

from estbench.consistency.intervals import positive_mean_bounds
from estbench.consistency.phases import EVENTS
from estbench.errors import EstbenchError
from estbench.report import contact
from estbench.report.figures.traces import pieces
from estbench.report.sources import Entry
from estbench.shapes import Array, Bool, Float, Int, Ints, Mask

BEFORE, AFTER = 10, 20
"""Instants before and after the event."""


@dataclass(frozen=True, eq=False)
class Around:
    """A mean by its distance from an event.

    Attributes:
        lag: instants after the event.
        mean: over the runs; NaN where none has such an instant.
        low, high: its interval across the runs, NaN for fewer than two.
    """

    lag: Int[Ints, " lag"]
    mean: Float[Array, " lag"]
    low: Float[Array, " lag"]
    high: Float[Array, " lag"]


def nees(entry: Entry, kind: str) -> Around:
    """NEES/n around the events of one kind, of the runs that did not diverge.

    Another event may be near: the curve tells when the excess is, not whether one event alone
    would cause it.

    Raises:
        EstbenchError: no run has such an event.
    """
    source, rows = entry.source, []
    for where, part in pieces(entry):
        seen, good = contact.seen(entry, source.runs[part].tolist()), entry.good[part]
        if seen is None:
            break
        group = entry.group.isel(run=where)
        ratio = group["nees"].values.astype(float) / np.maximum(source.rank(group), 1)
        event = seen.events[..., EVENTS.index(kind)].T
        rows.append(by_lag(ratio[good], event[good]))
    found = np.concatenate(rows) if rows else np.full((0, BEFORE + AFTER + 1), np.nan)
    if np.isnan(found).all():
        raise EstbenchError(
            f"no run of {entry.key} has an event '{kind}'; use runs in which the robot touches "
            "something, and name the event in contact.events"
        )
    count = np.isfinite(found).sum(axis=0)
    total = np.nansum(found, axis=0)
    mean = np.divide(total, count, out=np.full(len(total), np.nan), where=count > 0)
    square = np.nansum((found - mean) ** 2, axis=0)
    variance = np.divide(square, count - 1, out=np.full(len(total), np.nan), where=count > 1)
    low, high = positive_mean_bounds(mean, variance, np.maximum(count, 2), source.level)
    return Around(np.arange(-BEFORE, AFTER + 1), mean, np.asarray(low), np.asarray(high))


def by_lag(
    values: Float[Array, "run time"], event: Bool[Mask, "run time"]
) -> Float[Array, "run lag"]:
    """Mean of the values at each distance from the events of a run; NaN where there is none."""
    steps = values.shape[1]
    out = np.full((len(values), BEFORE + AFTER + 1), np.nan)
    for k, lag in enumerate(range(-BEFORE, AFTER + 1)):
        near = values[:, max(lag, 0) : steps + min(lag, 0)]
        at = event[:, max(-lag, 0) : steps - max(lag, 0)] & np.isfinite(near)
        count = at.sum(axis=1)
        total = np.where(at, near, 0.0).sum(axis=1)
        np.divide(total, count, out=out[:, k], where=count > 0)
    return out
