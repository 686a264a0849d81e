"""The table of the statistics by phase of contact."""

from collections.abc import Iterable

from estbench.consistency.phases import SHOWN, InPhase
from estbench.consistency.statistics import RMSE
from estbench.tables.cells import cell, plain, share
from estbench.tables.columns import Table, tabulate
from estbench.tables.quantity import quantity


def table(found: Iterable[tuple[str, tuple[InPhase, ...]]]) -> Table | None:
    """One row per estimator and phase; None where nothing is known by phase.

    Args:
        found: name of each estimator, and what `phases.by_phase` gives of it.
    """
    known = [(key, phase) for key, several in found for phase in several]
    if not known:
        return None
    units = known[0][1].rmse
    return tabulate(
        "By phase of contact",
        (
            "<estimator", "<phase", "share", *(s.heading for s in SHOWN.values()),
            *(f"{RMSE.heading}, {unit}" for unit in units),
        ),
        [
            (
                key, phase.name, share(phase.share),
                *(cell(s, value, "full") for s, value in zip(SHOWN.values(), phase.values)),
                *(quantity(phase.rmse[unit]) for unit in units),
            )
            for key, phase in known
        ],
        "Of the true robot: event is within contact.steps of an event, else stance touches "
        "something and flight nothing. Each run counts as one, by its mean over the phase; RMSE is "
        "that of the norm of all coordinates of a unit.",
    )  # fmt: skip


def numbers(found: tuple[InPhase, ...]) -> dict[str, dict[str, object]]:
    """The same of one estimator for JSON: phase -> numbers."""
    return {
        phase.name: {
            "share": phase.share,
            **{s.json_key: plain(v) for s, v in zip(SHOWN.values(), phase.values)},
            RMSE.json_key: {unit: plain(value) for unit, value in phase.rmse.items()},
        }
        for phase in found
    }
