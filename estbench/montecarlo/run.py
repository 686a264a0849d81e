"""Monte Carlo experiments: batches of runs on workers, interruptible, finished runs are kept."""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

from estbench.errors import ExecutorError, StoreError
from estbench.experiment import unseen
from estbench.experiment.setup import Setup, build, counted
from estbench.montecarlo import batch, dispatch, executors, forecast, scaling, stopping
from estbench.montecarlo.completion import Done, Plan, complete
from estbench.montecarlo.dispatch import Progress, Say
from estbench.montecarlo.pool import keeping
from estbench.montecarlo.results import Results
from estbench.scenario.load import Chosen, Scenario, resolve
from estbench.store import folders, resuming


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
    precision: float | None = None,
    precision_of: tuple[str, str] | None = None,
    until_decided: bool = False,
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
        runs: Monte Carlo runs, in place of the scenario's; at most, where a rule ends them.
        seed: in place of the scenario's.
        duration: s, in place of the scenario's.
        overrides: `section.key=value` strings.
        out: folder of the results; None writes nothing.
        keep: what is stored of each run; `auto` is `diagonal` if the traces of all runs take at
            most 1 GiB (`batch.TRACES_BYTES`), else `summary`, with a notice.
        dtype: of the stored traces; default `float64`, or that of the resumed store.
        precision: runs are added until the interval of NEES/n of every estimator has at most this
            half-width.
        precision_of: labels of two estimators; the precision is then that of the logarithm of the
            ratio of their RMSE, the geometric mean over the coordinates: 0.02 is 2%.
        until_decided: runs are added until no verdict is undecided.
        resume: continue `out` if it exists: only missing batches are computed, and runs are added
            if more are asked for.
        shard: (i, n) computes the i-th of n shares of the batches, 1 <= i <= n, into one store.
        executor: `threads`, `processes` (spawned, so that a script needs its
            `if __name__ == "__main__":`), `auto` (this process and spawned ones where they would
            finish first, else threads), or `dask`.
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
    rule = stopping.rule(precision, precision_of, until_decided, resolved)
    if rule is not None and shard is not None:
        raise ExecutorError(
            f"shard is {shard[0]}/{shard[1]}: a share of the runs cannot tell whether they are "
            "enough; leave it out, or give --runs alone"
        )
    prepared = build(resolved)
    level, notices = _level(prepared, keep, stored, out is not None)
    _check_disk(prepared, level, stored, out)
    size = batch_size or batch.default_batch_size(prepared, level)
    if rule is not None and batch_size is None:
        size = min(size, stopping.BATCH)
    total = resolved.simulation.runs
    using, found = scaling.pool(executor, prepared, total, size, level, workers, address)
    hidden = unseen.notice(prepared)
    if say is not None:
        for line in forecast.lines(prepared, size, level, using.workers, hidden, found):
            say(line)
    plan = Plan(
        using, size, level, stored, None if out is None else Path(out),
        (None if keep == "auto" else keep, dtype), resume, shard, progress, say, notices,
    )  # fmt: skip
    results = complete(prepared, plan, {}) if rule is None else _until(rule, prepared, plan)
    return replace(results, notices=(*results.notices, *([hidden] if hidden else [])))


def _until(rule: stopping.Rule, prepared: Setup, plan: Plan) -> Results:
    """Compute runs until a rule is met; a store is extended, so that it holds no run but these."""
    done: Done = {}
    most, size, begun = prepared.scenario.simulation.runs, plan.size, 0
    if plan.resume and plan.out is not None and folders.taken(plan.out):
        begun, size = resuming.extent(plan.out)
        most = max(most, begun)

    with keeping(plan.using) as using:
        for count in stopping.looks(size, most, begun):
            progress = _onwards(plan.progress, count, most)
            now = replace(plan, using=using, progress=progress)
            results = complete(counted(prepared, count), now, done)
            plan = replace(plan, resume=True)
            if results.interrupted or results.failed or rule.met(results):
                break
    if results.interrupted or results.failed:
        return results
    return replace(results, notices=(*results.notices, rule.said(results, most)))


def _onwards(progress: Progress | None, count: int, most: int) -> Progress | None:
    """The progress up to `count` runs as a part of the whole."""
    return progress and (lambda finished, wanted: progress(count - wanted + finished, most))


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


def _check_disk(prepared: Setup, keep: str, dtype: str, out: str | Path | None) -> None:
    """Refuse traces of twice the size of what is free on the disk, however they are compressed."""
    if out is None or keep == "summary":
        return
    parent = next(p for p in Path(out).absolute().parents if p.exists())
    needed, free = batch.trace_bytes(prepared, dtype, keep), shutil.disk_usage(parent).free
    if needed > 2 * free:
        raise StoreError(
            f"keep is '{keep}': the traces of all runs take {needed / 2**30:.3g} GiB before they "
            f"are compressed, and {free / 2**30:.3g} are free in {parent}; use --keep summary, or "
            "fewer --runs"
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
