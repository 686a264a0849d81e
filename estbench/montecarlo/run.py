"""Monte Carlo experiments: batches of runs on workers, interruptible, finished runs are kept."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

from estbench.bounds import scenario as bounds
from estbench.consistency.fields import Record
from estbench.consistency.records import merge
from estbench.consistency.summary import summarize
from estbench.errors import ExecutorError, Interrupted, StoreError
from estbench.experiment import unseen
from estbench.experiment.setup import Setup, build
from estbench.montecarlo import batch, dispatch, executors, forecast
from estbench.montecarlo.dispatch import Progress
from estbench.montecarlo.pool import Pool
from estbench.montecarlo.results import Results
from estbench.scenario.load import Chosen, Scenario, resolve
from estbench.store.zarr import Store

Say = Callable[[str], None]
"""Called with a notice that the user should read before the runs are computed."""


def run(
    scenario: str | Path | Scenario,
    estimators: Chosen | None = None,
    *,
    runs: int | None = None,
    seed: int | None = None,
    duration: float | None = None,
    overrides: Sequence[str] = (),
    out: str | Path | None = None,
    keep: Literal["auto", "summary", "diagonal", "full"] = "auto",
    dtype: Literal["float64", "float32"] | None = None,
    resume: bool = False,
    shard: tuple[int, int] | None = None,
    executor: Literal["auto", "threads", "processes", "dask"] = "threads",
    address: str | None = None,
    workers: int | None = None,
    batch_size: int | None = None,
    progress: Progress | None = None,
    say: Say | None = None,
) -> Results:
    """Simulate, observe, estimate, compare.

    Args:
        scenario: a bundled name, a TOML or MJCF path, a results folder, or a `Scenario`.
        estimators: labels, names or classes, in place of the scenario's; one needs no list.
        runs: Monte Carlo runs, in place of the scenario's.
        seed: in place of the scenario's.
        duration: s, in place of the scenario's.
        overrides: `section.key=value` strings.
        out: folder of the results; None writes nothing.
        keep: what is stored of each run; `auto` is `diagonal` if the traces of all runs take at
            most 1 GiB (`batch.TRACES_BYTES`), else `summary`, with a notice.
        dtype: of the stored traces; default `float64`, or that of the resumed store.
        resume: continue `out` if it exists: only missing batches are computed.
        shard: (i, n) computes the i-th of n shares of the batches, 1 <= i <= n, into one store.
        executor: `threads`, `processes` (spawned, so that a script needs its
            `if __name__ == "__main__":`), `auto` (processes for long work on many CPUs), or `dask`.
        address: of the dask scheduler.
        workers: count of threads or processes; default the CPUs this process may use, or as many
            as the memory allows.
        batch_size: runs per batch; default by memory. It does not change the results.
        progress: called after each batch.
        say: called with what matters before the runs are computed: that they will take long, and
            that a store was begun with other versions.

    Returns:
        The results; `print` shows the tables. After Ctrl-C, the results of the finished runs.

    Raises:
        EstbenchError: the input is wrong; nothing has been written.
    """
    stored = dtype or "float64"
    _check(out, keep, stored, resume, shard, executor, address, workers, batch_size)
    resolved = resolve(scenario, estimators, runs, seed, duration, overrides)
    prepared = build(resolved)
    level, notices = _level(prepared, keep, stored, out is not None)
    size = batch_size or batch.default_batch_size(prepared, level)
    a_run = batch.run_bytes(prepared, level) + batch.working_bytes(prepared)
    using = _pool(prepared, executor, address, workers, size * a_run)
    hidden = unseen.notice(prepared)
    blind = [hidden] if hidden else []
    if say is not None:
        for line in forecast.lines(prepared, size, level, using.workers, hidden):
            say(line)
    if out is None:
        count = resolved.simulation.runs
        batches = [range(i, min(i + size, count)) for i in range(0, count, size)]
        done, failed, interrupted = dispatch.compute(
            prepared, dict(enumerate(batches)), level, using, None, {}, progress
        )
        return _collect(prepared, batches, done, failed, None, interrupted, blind)
    target = _open(Path(out), prepared, level, size, stored, resume, shard)
    for name, was, value in (("keep", target.keep, keep), ("dtype", target.dtype, dtype)):
        if value not in ("auto", None, was):
            raise StoreError(
                f"{out} is of another experiment: {name} was {was!r} and is {value!r}; "
                "choose another --out"
            )
    with target.lock(shard):
        done, corrupted = _finished(target)
        indices = range(len(target.batches)) if shard is None else _share(target, shard)
        wanted = {i: target.batches[i] for i in indices if i not in done}
        mixed = target.sign(writing=bool(wanted))
        if mixed and wanted and say is not None:
            say(mixed)
        try:
            done, failed, interrupted = dispatch.compute(
                prepared, wanted, target.keep, using, target, done, progress
            )
            if interrupted:  # a worker may have written a batch and not reported it
                done = {**_finished(target)[0], **done}
        finally:
            if not done and shard is None:
                target.discard()
    again = [i for i in corrupted if i in wanted]
    return _collect(
        prepared, target.batches, done, failed, target, interrupted,
        [
            *blind,
            *(notices if target.keep == level else ()),
            *([mixed] if mixed else ()),
            *(f"{name} was damaged and has been written again" for name in target.restored),
            *(f"batch {i} of the store was corrupted and has been computed again" for i in again),
        ],
    )  # fmt: skip


def _check(
    out: str | Path | None,
    keep: str,
    dtype: str,
    resume: bool,
    shard: tuple[int, int] | None,
    executor: str,
    address: str | None,
    workers: int | None,
    batch_size: int | None,
) -> None:
    """Check the arguments, each by itself and in combination."""
    dispatch.check_shard(shard)
    if out is not None and not isinstance(out, str | Path):
        raise StoreError(f"out is {out!r}; use the path of a folder")
    for name, value in (("batch_size", batch_size), ("workers", workers)):
        executors.check_count(name, value)
    for name, value, known in (
        ("keep", keep, ("auto", "summary", "diagonal", "full")),
        ("dtype", dtype, ("float64", "float32")),
    ):
        if value not in known:
            raise StoreError(f"{name} is {value!r}; use one of {', '.join(known)}")
    dispatch.check_folder(out, resume, shard)
    if address is not None and executor != "dask":
        raise ExecutorError(
            f"address is {address!r}, that of a dask scheduler, but executor is {executor!r}; add "
            "--executor dask, or leave the address out"
        )


def _level(prepared: Setup, keep: str, dtype: str, stored: bool) -> tuple[str, tuple[str, ...]]:
    """What is stored of each run, and a notice about it."""
    if keep != "auto":
        return keep, ()
    level = batch.default_keep(prepared, dtype)
    if level == "diagonal" or not stored:
        return level, ()
    size, most = (x / 2**30 for x in (batch.trace_bytes(prepared, dtype), batch.TRACES_BYTES))
    return level, (
        f"the traces of all runs would take {size:.3g} GiB, more than {most:.3g}: only averages "
        "are stored; --keep diagonal stores the traces too",
    )


def _pool(prepared: Setup, kind: str, address: str | None, workers: int | None, size: int) -> Pool:
    """The pool, with as many workers as fit the machine."""
    if kind == "auto":
        scenario = prepared.scenario
        steps = scenario.simulation.runs * len(prepared.times) * max(1, len(scenario.estimators))
        kind = executors.choose(steps, executors.worker_count(workers))
    return executors.pool(kind, workers or executors.fitting(kind, size), address)


def _open(
    folder: Path,
    prepared: Setup,
    keep: str,
    size: int,
    dtype: str,
    resume: bool,
    shard: tuple[int, int] | None,
) -> Store:
    """A new store, or the resumed one; of several shards the first makes it."""
    if (resume or shard is not None) and folder.exists():
        return Store.reopen(folder, prepared)
    try:
        return Store.create(folder, prepared, keep, size, dtype)
    except StoreError:
        if shard is None or not folder.exists():
            raise
        return Store.reopen(folder, prepared)


def _share(target: Store, shard: tuple[int, int]) -> range:
    return range(shard[0] - 1, len(target.batches), shard[1])


def _finished(target: Store) -> tuple[dict[int, dict[str, Record]], list[int]]:
    """Summary records of the finished batches, and the numbers of the corrupted ones."""
    done, corrupted = {}, []
    for index in range(len(target.batches)):
        if target.finished(index):
            found = target.read(index)
            if found is None:
                corrupted.append(index)
            else:
                done[index] = found
    return done, corrupted


def _collect(
    prepared: Setup,
    batches: Sequence[range],
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
    section = prepared.scenario.consistency
    return Results(
        scenario=prepared.scenario,
        names=prepared.space.names,
        units=prepared.space.units,
        times=prepared.times,
        steps=sum(instant.control for instant in prepared.instants),
        runs=tuple(runs),
        summaries=tuple(
            summarize(
                label,
                record,
                runs,
                prepared.times,
                section,
                prepared.space.names,
                tuple(prepared.channel_spaces),
                prepared.scenario.contact,
            )
            for label, record in merged.items()
        ),
        records=merged,
        notices=(
            *prepared.notices,
            *bounds.notices(prepared),
            *notices,
            *dispatch.missing(batches, failed),
        ),
        folder=target.folder if target is not None else None,
        interrupted=interrupted,
        failed=len(failed),
    )
