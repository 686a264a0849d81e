"""Phases of contact: flight, stance, and the steps around an event, each with its statistics.

A filter may be consistent in flight and in stance and lose its consistency at the touch-down; an
average over the whole run does not tell where.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np

from estbench.consistency.declaration import Sample, Statistic
from estbench.consistency.fields import PHASES, Record
from estbench.consistency.intervals import Interval, positive_mean_interval
from estbench.consistency.statistics import ANEES, ANIS
from estbench.scenario.schema import ContactEvent, ContactSection
from estbench.shapes import Array, Bool, Float, Mask

EVENTS: tuple[str, ...] = get_args(ContactEvent)
SHOWN: dict[str, Statistic] = {"anees_by_phase": ANEES, "anis_by_phase": ANIS}
"""Variable of the record -> the statistic that is computed from it in each phase."""


@dataclass(frozen=True, eq=False)
class InPhase:
    """One estimator in one phase.

    Attributes:
        name: of `PHASES`.
        share: of the instants that count, over all runs.
        values: of the statistics of `SHOWN`, over the runs that did not diverge and have the phase.
        rmse: unit -> RMSE of the norm of the error in all coordinates of the unit.
    """

    name: str
    share: float
    values: tuple[Interval, ...]
    rmse: dict[str, Interval]


def described(section: ContactSection) -> tuple[str, ...]:
    """Where each of `PHASES` is, as a sentence says it."""
    kinds = " or ".join(f"a {kind}" for kind in section.events)
    steps = f"{section.steps} step{'s' * (section.steps != 1)}"
    return "in flight", "in stance", f"within {steps} of {kinds}"


def events(
    touching: Bool[Mask, "time run body"],
    slipping: Bool[Mask, "time run body"],
    limited: Bool[Mask, "time run joint"],
) -> Bool[Mask, "time run kind"]:
    """Which kinds of `EVENTS` happen at each instant, of any body or joint.

    An event is at the first instant of the new state: a touch-down at the first instant with the
    contact. A slip begins in a contact that has been there before; reaching and leaving a limit
    are both an event.
    """
    out = np.zeros((*touching.shape[:2], len(EVENTS)), bool)
    now, before = touching[1:], touching[:-1]
    found = (
        now & ~before,
        before & ~now,
        slipping[1:] & ~slipping[:-1] & before,
        limited[1:] ^ limited[:-1],
    )
    for kind, changed in enumerate(found):
        out[1:, :, kind] = changed.any(axis=-1)
    return out


def phases(
    times: Float[Array, " time"],
    touching: Bool[Mask, "time run"],
    event: Bool[Mask, "time run"],
    window: float,
    last: Float[Array, " run"] | float = -np.inf,
) -> Bool[Mask, "time run phase"]:
    """The phase of each instant, in the order of `PHASES`.

    Args:
        times: s.
        touching: whether the robot touches anything.
        event: whether an event happens.
        window: s before and after an event that belong to it.
        last: time of the last event before these instants, s.
    """
    t = times[:, None]
    last = np.maximum(np.maximum.accumulate(np.where(event, t, -np.inf)), last)
    following = np.minimum.accumulate(np.where(event, t, np.inf)[::-1])[::-1]
    near = np.minimum(t - last, following - t) <= window * (1 + 1e-9) + 1e-12
    return np.stack([~near & ~touching, ~near & touching, near], axis=-1)


def by_phase(record: Record, units: Sequence[str], level: float) -> tuple[InPhase, ...]:
    """The statistics of each phase that occurs; empty where all instants are of one phase.

    Args:
        record: as `records.merge` gives it; one of an earlier version has no phases.
        units: of the coordinates.
        level: confidence.
    """
    steps = record.get("phase_steps", np.zeros((1, len(PHASES)), np.int64))
    total = steps.sum(axis=0)
    if np.count_nonzero(total) < 2:
        return ()
    good = ~record["diverged"].astype(bool)
    return tuple(
        InPhase(
            name,
            float(total[p] / total.sum()),
            tuple(_value(s, record[name_of][good, p], level) for name_of, s in SHOWN.items()),
            _rmse(record["mse_by_phase"][good, p], units, level),
        )
        for p, name in enumerate(PHASES)
        if total[p]
    )


def _value(statistic: Statistic, values: Float[Array, " good"], level: float) -> Interval:
    """A declared statistic over the runs that have the phase."""
    there = values[~np.isnan(values)]
    (variable,) = statistic.variables
    sample = {variable: there, "diverged": np.zeros(len(there), bool)}
    found = statistic.of(Sample(sample, level, 0))
    assert isinstance(found, Interval)  # as all of `SHOWN`
    return found


def _rmse(mse: Float[Array, "good n"], units: Sequence[str], level: float) -> dict[str, Interval]:
    there = mse[~np.isnan(mse).any(axis=1)]
    of = {unit: [i for i, u in enumerate(units) if u == unit] for unit in dict.fromkeys(units)}
    return {
        unit: positive_mean_interval(there[:, members].sum(axis=1), level).root()
        for unit, members in of.items()
    }
