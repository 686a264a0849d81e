"""Rules for causes that show in the settings or at one time."""

from collections.abc import Sequence

import numpy as np

from estbench.analysis.courses import course
from estbench.analysis.evidence import Evidence
from estbench.analysis.finding import Finding, Rule, above, below
from estbench.consistency.blocks import span
from estbench.consistency.fields import PHASES
from estbench.consistency.hypotheses import BIASES
from estbench.consistency.intervals import Interval
from estbench.consistency.phases import described
from estbench.consistency.verdict import SIZES
from estbench.consistency.verdict import above as too_large
from estbench.scenario.believed import believed
from estbench.shapes import Array, Float
from estbench.tables.quantity import quantity

LARGER = 1.5
"""How many times as large NEES/n must be near contact as elsewhere, by its interval."""


def latency(e: Evidence) -> Finding | None:
    """The errors are too large, and late readings are fused as if they were current."""
    belief = believed(e.scenario, e.label)
    wrong: dict[str, tuple[float, float]] = {}
    for name in e.channels:
        true = e.scenario.channels[name].latency if name in e.scenario.channels else None
        told = belief.channels[name].latency if name in belief.channels else None
        taken = 0.0 if belief.delays == "naive" else told
        if taken is not None and abs((true or 0.0) - taken) > 1e-9:
            wrong[name] = true or 0.0, taken
    failing = any(h.kind in BIASES or too_large(h) for h in e.refuted(*SIZES, *BIASES))
    if not wrong or not failing:
        return None
    shown = ", ".join(
        f"{name} is {true:g} s late and taken as {taken:g} s"
        for name, (true, taken) in wrong.items()
    )
    return Finding(
        "latency", f"{shown}; NEES/n is {quantity(e.nees)}",
        'the true latency: `filter.delays = "exact"`, and no other `filter.channels.NAME.latency`',
    )  # fmt: skip


def start(e: Evidence) -> Finding | None:
    """The errors fit P in all but the first blocks: P₀ or x̂₀ is wrong."""
    found = course(e)
    if found is None:
        return None
    for wrong, word in ((found.high, "too small, or x̂₀ is wrong"), (found.low, "too large")):
        count = int(np.argmin(wrong))  # the first block that is right
        if not 0 < count <= len(wrong) // 2 or wrong[count:].any():
            continue
        others = found.others(e, wrong)
        if not above(others) and not below(others):
            return Finding(
                "start",
                f"P₀ is {word}: {found.what} is {quantity(found.block(e, 0))} at first, wrong "
                f"{span(e.spans[:count])} and {quantity(others)} after that",
                "`start.inflate`, a right `start.offset`, or `start.method = \"batch\"`",
            )  # fmt: skip
    return None


def some_time(e: Evidence) -> Finding | None:
    """The errors are too large in some blocks that do not begin with the start."""
    found = course(e)
    if found is None or not found.high.any():
        return None
    high = found.high
    if high[0] or high.sum() > len(high) // 2 or above(found.others(e, high)):
        return None
    first = int(np.argmax(high))
    last = first + int(np.argmin(np.append(high[first:], False)))
    worst = max((found.block(e, i) for i in range(first, last)), key=lambda i: i.value)
    return Finding(
        "event",
        f"{found.what} is up to {quantity(worst)} {span(e.spans[first:last])} only: something "
        "happens then that the filter's model lacks (contact, saturation, a fault, a change of the "
        "noise)",
        "a filter for contact (`rotated_ukf`), a `schedule` of the noise, or a model of the event",
    )  # fmt: skip


def contact(e: Evidence) -> Finding | None:
    """The errors are too large from the first event of contact on, or near the events.

    What goes wrong at an event lasts, so that the phases after it may be as wrong.
    """
    if "nees_around_contact" not in e.record or not any(map(too_large, e.refuted(*SIZES))):
        return None
    event = PHASES.index("event")
    around, near = e.record["nees_around_contact"], e.record["anees_by_phase"][:, event]
    where = described(e.scenario.contact)[event]
    before, since = _both(e, around[:, 0], around[:, 1])
    rest, here = _both(e, _without(e, event), near)
    if above(since) and not above(before) and since.low > LARGER * before.value:
        shown = (
            f"{quantity(before)} until the run comes {where}, and {quantity(since)} from then on"
        )
    elif above(here) and here.low > LARGER * rest.value:
        shown = f"{quantity(here)} {where}, and {quantity(rest)} elsewhere"
    else:
        return None
    return Finding(
        "contact",
        f"NEES/n is {shown}: the filter's approximation of the transition fails at the kinks of "
        "contact",
        "a filter for contact (`rotated_ukf`, `diplf`; docs/contact.md)",
    )


def _both(
    e: Evidence, one: Float[Array, " run"], other: Float[Array, " run"]
) -> tuple[Interval, Interval]:
    """The means of two ratios over the runs that have both."""
    both = np.isfinite(one) & np.isfinite(other)
    return e.ratio(one[both])[0], e.ratio(other[both])[0]


def _without(e: Evidence, phase: int) -> Float[Array, " run"]:
    """NEES/n of each run over the instants of the other phases."""
    others = np.arange(len(PHASES)) != phase
    steps = e.record["phase_steps"][:, others]
    total = np.where(steps > 0, e.record["anees_by_phase"][:, others] * steps, 0.0).sum(axis=1)
    count = steps.sum(axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


DIRECT: Sequence[Rule] = (latency, start, contact, some_time)
