"""The contacts of a stored run."""

from estbench.analysis.load import array
from estbench.experiment import contact, setup
from estbench.report.sources import Entry
from estbench.shapes import Array


def truth(prepared: setup.Setup, entry: Entry, place: int) -> Array:
    """True states `(K + 1, nx)` of a stored run, by its place in the store."""
    if prepared.scenario.control.observe == "estimate":  # the truth depends on the estimator
        group = entry.group.isel(run=place)
        return prepared.space.plus(group["estimate"].values, group["error"].values)
    return array(entry.source.tree, "truth/x").isel(run=place).values


def events(entry: Entry, run: int) -> dict[str, Array]:
    """Kind -> times of the events of a stored run with traces, s; empty without contacts."""
    place = entry.position(run)
    if place is None:
        raise entry.no_run(run)
    prepared = setup.build(entry.source.scenario)
    seen = contact.seen(prepared, truth(prepared, entry, place)[:, None], [run])
    return {} if seen is None else seen.times(prepared.times, 0)
