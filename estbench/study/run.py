"""Compute a study: variants on workers, one store, interruptible and resumable."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal

from estbench.errors import Interrupted, StudyError
from estbench.montecarlo import batch, executors, scaling
from estbench.montecarlo.dispatch import Progress, check_folder, check_shard
from estbench.store import folders
from estbench.store.template import lengths
from estbench.study import compute as computing
from estbench.study.compute import Outcomes, Piece
from estbench.study.design import Study
from estbench.study.evaluation import KEPT
from estbench.study.findings import Findings, collect
from estbench.study.store import StudyStore

Executor = Literal["auto", "threads", "processes", "dask"]


def run(
    study: Study,
    *,
    out: str | Path | None = None,
    resume: bool = False,
    shard: tuple[int, int] | None = None,
    executor: Executor = "threads",
    address: str | None = None,
    workers: int | None = None,
    batch_size: int | None = None,
    progress: Progress | None = None,
) -> Findings:
    """Compute every variant on the same runs; truth and readings once per group that shares them.

    Args:
        study: the variants.
        out: folder of the store; None writes nothing.
        resume: continue `out` if it exists.
        shard: (i, n) computes the i-th of n shares of the pieces, 1 <= i <= n, into one store.
        executor: as for `estbench.run`.
        address: of the dask scheduler.
        workers: count of threads or processes.
        batch_size: runs per batch; it does not change the results.
        progress: called after each piece.

    Raises:
        EstbenchError: the input is wrong; nothing has been written.
    """
    check_folder(out, resume, shard)
    check_shard(shard)
    for name, value in (("batch_size", batch_size), ("workers", workers)):
        executors.check_count(name, value)
    prepared = computing.prepare(study)
    bases = [group[0] for group in prepared]
    names = {base.space.names for base in bases}
    if len(names) > 1:
        raise StudyError("the variants have different states; vary keys that leave the state as is")
    first = bases[0]
    sizes = [lengths(base, "summary") for base in bases]
    common = {d: n for d, n in sizes[0].items() if all(s[d] == n for s in sizes)}
    needed = {d for field in KEPT.values() for d in field.dims if d != "run"}
    if not needed <= common.keys():
        raise StudyError(
            f"the variants differ in their count of {', '.join(sorted(needed - common.keys()))}; "
            "vary keys that leave it as it is"
        )
    level = "summary"
    size = batch_size or batch.default_batch_size(first, level)
    total = study.scenario.simulation.runs * len(study.variants)
    using, _ = scaling.pool(executor, first, total, size, level, workers, address)
    pieces: dict[Piece, Outcomes] = {}
    kept = {d: common[d] for d in sorted(needed)}  # the same file in each process
    store = None
    if out is None:
        runs = study.scenario.simulation.runs
        batches = [range(i, min(i + size, runs)) for i in range(0, runs, size)]
    else:
        store = _opened(Path(out), study, kept, first, size, resume, shard is not None)
        batches = store.batches
    every = [(g, b) for g in range(len(prepared)) for b in range(len(batches))]
    mine = every if shard is None else every[shard[0] - 1 :: shard[1]]

    def keep(piece: Piece, outcomes: Outcomes) -> None:
        if store is not None:
            store.write(piece, outcomes)
        pieces[piece] = outcomes

    def calculate() -> tuple[dict[Piece, Exception], bool]:
        if store is not None:
            for piece in every:
                found = store.read(piece) if store.finished(piece) else None
                if found is not None:
                    pieces[piece] = found
        wanted = [piece for piece in mine if piece not in pieces]
        return computing.compute(prepared, batches, wanted, using, keep, progress)

    errors, interrupted = _locked(store, shard, calculate)
    if errors and not pieces:
        raise next(iter(errors.values()))
    runs, records, failures = collect(study, pieces, batches, kept)
    if not runs:
        if shard is not None and not interrupted:
            raise Interrupted(
                f"the share {shard[0]}/{shard[1]} is finished; no run has all variants yet"
            )
        raise Interrupted("interrupted before the first batch was finished: there is no result")
    by_variant = {
        i: prepared[g][k].times
        for g, group in enumerate(study.groups)
        for k, i in enumerate(group.ravel().tolist())
    }
    restored = () if store is None else store.restored
    again = [f"{name} was damaged and has been written again" for name in restored]
    missing = [f"a batch is missing: {error}" for error in dict.fromkeys(map(str, errors.values()))]
    return Findings(
        study, first.space.names, first.space.units, tuple(first.channel_spaces),
        tuple(by_variant[i] for i in range(len(study.variants))), runs, records, failures,
        None if store is None else store.folder, interrupted, (*first.notices, *again, *missing),
    )  # fmt: skip


def _opened(
    folder: Path,
    study: Study,
    sizes: dict[str, int],
    first: computing.Setup,
    batch_size: int,
    resume: bool,
    shared: bool,
) -> StudyStore:
    """A new store, or the one that is resumed."""
    coordinates = {"coordinate": first.space.names}
    if "channel" in sizes:
        coordinates["channel"] = tuple(first.channel_spaces)
    parts = folder, study, sizes, coordinates, batch_size
    return folders.opened(
        folder, resume, shared, partial(StudyStore.create, *parts),
        partial(StudyStore.reopen, *parts),
    )  # fmt: skip


def _locked(
    store: StudyStore | None,
    shard: tuple[int, int] | None,
    calculate: Callable[[], tuple[dict[Piece, Exception], bool]],
) -> tuple[dict[Piece, Exception], bool]:
    """Calculate while the store is locked."""
    if store is None:
        return calculate()
    with store.lock(shard):
        return calculate()
