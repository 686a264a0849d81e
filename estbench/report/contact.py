"""The contacts of stored runs."""

from collections.abc import Mapping, Sequence

from estbench.analysis.stored import array
from estbench.experiment import contact, setup
from estbench.report.sources import Entry
from estbench.shapes import Array

Events = Mapping[str, Array]
"""Kind -> times of the events of one run, s."""


def truth(prepared: setup.Setup, entry: Entry, places: Sequence[int]) -> Array:
    """True states `(K + 1, run, nx)` of stored runs, by their places in the store."""
    if _own_truth(entry):
        group = entry.group.isel(run=list(places))
        x = prepared.space.plus(group["estimate"].values, group["error"].values)
    else:
        x = array(entry.source.tree, "truth/x").isel(run=list(places)).values
    return x.swapaxes(0, 1)


def seen(entry: Entry, runs: Sequence[int]) -> contact.Seen | None:
    """What stored runs with traces touch; None without contacts."""
    places = [place for run in runs if (place := entry.position(run)) is not None]
    if len(places) < len(runs):
        raise entry.no_run(next(run for run in runs if entry.position(run) is None))
    prepared = setup.build(entry.source.scenario)
    return contact.seen(prepared, truth(prepared, entry, places), runs)


def events(entry: Entry, runs: Sequence[int]) -> list[Events]:
    """The events of stored runs with traces; empty without contacts."""
    found = seen(entry, runs)
    times = entry.source.times
    return [{} if found is None else found.times(times, k) for k in range(len(runs))]


def events_of_entries(entries: Sequence[Entry], runs: Sequence[int]) -> list[dict[int, Events]]:
    """Of each entry with traces the events by run; computed once for entries that share a truth."""
    known: dict[int, dict[int, Events]] = {}
    out = []
    for entry in entries:
        whose = id(entry) if _own_truth(entry) else id(entry.source)
        if whose not in known and entry.source.has_traces and entry.source.log is None:
            there = [run for run in runs if entry.position(run) is not None]
            known[whose] = dict(zip(there, events(entry, there))) if there else {}
        out.append(known.get(whose, {}))
    return out


def _own_truth(entry: Entry) -> bool:
    """Whether the truth depends on the estimator."""
    return entry.source.scenario.control.observe == "estimate"
