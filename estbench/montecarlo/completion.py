"""The missing runs of an experiment computed and stored, and the results of all of them."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from estbench.bounds import scenario as bounds
from estbench.consistency.fields import Record
from estbench.consistency.records import merge
from estbench.consistency.summary import summarize
from estbench.errors import Interrupted
from estbench.experiment import long
from estbench.experiment.setup import Setup
from estbench.montecarlo import dispatch
from estbench.montecarlo.dispatch import Progress, Say
from estbench.montecarlo.pool import Pool
from estbench.montecarlo.results import Results
from estbench.store import folders
from estbench.store.contents import divided
from estbench.store.zarr import Store

Done = dict[int, dict[str, Record]]
"""Number of a finished batch -> label -> its summary record."""


@dataclass(frozen=True)
class Plan:
    """How the runs of an experiment are computed, and where they are kept.

    Attributes:
        using: the workers.
        size: runs of a batch; a store that is continued has its own.
        level: what a new store keeps of each run: `summary`, `diagonal` or `full`.
        dtype: of its traces.
        out: folder of the store; None writes nothing.
        wanted: level and type that a store must have, None for any.
        resume: whether the store may exist.
        shard: (i, n) computes the i-th of n shares of the batches.
        progress, say: as for `estbench.run`.
        notices: about a new store.
        number: of the experiment in this process.
    """

    using: Pool
    size: int
    level: str
    dtype: str = "float64"
    out: Path | None = None
    wanted: tuple[str | None, str | None] = (None, None)
    resume: bool = False
    shard: tuple[int, int] | None = None
    progress: Progress | None = None
    say: Say | None = None
    notices: tuple[str, ...] = ()
    number: int = field(default_factory=lambda: next(dispatch.EXPERIMENTS))


def complete(prepared: Setup, plan: Plan, done: Done) -> Results:
    """Compute the runs that are missing.

    Args:
        prepared: the experiment; it says how many runs there are.
        plan: how.
        done: batches of the same size that are finished, of this process; new ones are added.

    Raises:
        EstbenchError: the store cannot be written, or no batch can be computed.
    """
    if plan.out is None:
        batches = divided(prepared.scenario.simulation.runs, plan.size)
        wanted = {i: runs for i, runs in enumerate(batches) if i not in done}
        done, failed, interrupted = dispatch.compute(
            prepared, wanted, plan.level, plan.using, None, done, plan.progress, plan.number
        )
        return _collect(prepared, batches, plan.level, done, failed, None, interrupted)
    target = folders.opened(
        plan.out,
        plan.resume,
        plan.shard is not None,
        partial(Store.create, plan.out, prepared, plan.level, plan.size, plan.dtype),
        partial(Store.reopen, plan.out, prepared, *plan.wanted),
    )
    with target.lock(plan.shard):
        corrupted = _read(target, done)
        every = range(len(target.batches)) if plan.shard is None else _share(target, plan.shard)
        wanted = {i: target.batches[i] for i in every if i not in done}
        mixed = target.sign(writing=bool(wanted))
        if mixed and wanted and plan.say is not None:
            plan.say(mixed)
        try:
            done, failed, interrupted = dispatch.compute(
                prepared, wanted, target.keep, plan.using, target, done, plan.progress, plan.number
            )
            if interrupted:  # a worker may have written a batch and not reported it
                _read(target, done)
        finally:
            if not done and plan.shard is None:
                target.discard()
    again = [i for i in corrupted if i in wanted]
    return _collect(
        prepared, target.batches, target.keep, done, failed, target, interrupted,
        [
            *(plan.notices if target.keep == plan.level else ()),
            *([mixed] if mixed else ()),
            *(f"{name} was damaged and has been written again" for name in target.restored),
            *(f"batch {i} of the store was corrupted and has been computed again" for i in again),
        ],
    )  # fmt: skip


def _share(target: Store, shard: tuple[int, int]) -> range:
    return range(shard[0] - 1, len(target.batches), shard[1])


def _read(target: Store, done: Done) -> list[int]:
    """Add the finished batches of a store that are not known; the numbers of the corrupted ones."""
    corrupted = []
    for index in range(len(target.batches)):
        if index not in done and target.finished(index):
            found = target.read(index)
            if found is None:
                corrupted.append(index)
            else:
                done[index] = found
    return corrupted


def _collect(
    prepared: Setup,
    batches: Sequence[range],
    keep: str,
    done: dict[int, dict[str, Record]],
    failed: dict[int, Exception],
    target: Store | None,
    interrupted: bool,
    notices: Sequence[str] = (),
) -> Results:
    """The results of the finished batches."""
    if not done and failed:
        raise next(iter(failed.values()))
    if not done:
        raise Interrupted("interrupted before the first batch was finished: there is no result")
    order = sorted(done)
    runs = [run for i in order for run in batches[i]]
    merged = {
        label: merge([done[i][label] for i in order]) for label in prepared.scenario.estimators
    }
    section, times = prepared.scenario.consistency, long.sampled_times(prepared, keep)
    return Results(
        scenario=prepared.scenario,
        names=prepared.space.names,
        units=prepared.space.units,
        times=times,
        steps=prepared.steps,
        instants=len(prepared.instants),
        runs=tuple(runs),
        summaries=tuple(
            summarize(
                label,
                record,
                runs,
                times,
                section,
                prepared.space.names,
                tuple(prepared.channel_spaces),
                prepared.scenario.contact,
                instants=len(prepared.instants),
            )
            for label, record in merged.items()
        ),
        records=merged,
        notices=(
            *prepared.notices,
            *bounds.notices(prepared),
            *long.notices(prepared, keep),
            *notices,
            *dispatch.missing(batches, failed),
        ),
        folder=target.folder if target is not None else None,
        interrupted=interrupted,
        failed=len(failed),
    )
