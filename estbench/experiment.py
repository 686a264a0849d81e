"""Monte Carlo: many runs in batches on workers, interruptible, every finished run kept."""

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from estbench import executors, records, setup, statistics, store, streams, worker
from estbench import scenario as scenarios
from estbench.errors import (
    EstbenchError,
    EstimatorError,
    ExecutorError,
    Interrupted,
    ScenarioError,
    StoreError,
    did_you_mean,
)
from estbench.estimators import registry
from estbench.filtering import Live, Recorded, Traces, run_filter
from estbench.results import Results
from estbench.truth import Trajectory, simulate

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]
"""Called with the runs done and the runs in all."""

BATCH_BYTES = 64 * 2**20
"""Memory that the traces of one batch may take."""


@dataclass(frozen=True, eq=False)
class Batch:
    """What one batch of runs gave: the true states and a record an estimator."""

    truth: records.Record
    records: dict[str, records.Record]


def run(
    scenario: str | Path | scenarios.Scenario,
    estimators: Sequence[str] | None = None,
    *,
    runs: int | None = None,
    seed: int | None = None,
    duration: float | None = None,
    overrides: Sequence[str] = (),
    out: str | Path | None = None,
    keep: Literal["summary", "diagonal", "full"] = "diagonal",
    dtype: Literal["float64", "float32"] = "float64",
    resume: bool = False,
    shard: tuple[int, int] | None = None,
    executor: Literal["threads", "processes", "dask"] = "threads",
    address: str | None = None,
    workers: int | None = None,
    batch_size: int | None = None,
    progress: Progress | None = None,
) -> Results:
    """Simulate, observe, estimate, compare.

    Args:
        scenario: a bundled name, a TOML or MJCF path, a results folder, or a `Scenario`.
        estimators: labels or names to run in place of the scenario's.
        runs: Monte Carlo runs, in place of the scenario's.
        seed: in place of the scenario's.
        duration: s, in place of the scenario's.
        overrides: `section.key=value` strings.
        out: folder to write the results to; None writes nothing.
        keep: what the store keeps of every run.
        dtype: of the stored traces.
        resume: go on with `out` if it exists: only what is missing is computed.
        shard: (i, n) computes the i-th of n shares of the batches, 1 <= i <= n, into one store.
        executor: `threads`, `processes` (spawned; for many cores), or `dask`.
        address: of the dask scheduler.
        workers: threads or processes; default the CPUs this process may use.
        batch_size: runs a batch; default by memory. It does not change the results.
        progress: called after every batch.

    Returns:
        The results; `print` shows the tables. After Ctrl-C those of the finished runs.

    Raises:
        EstbenchError: anything wrong with the input, before anything is written.
    """
    if shard is not None and not 1 <= shard[0] <= shard[1]:
        raise ExecutorError(f"shard is {shard[0]}/{shard[1]}; use i/n with 1 <= i <= n")
    for name, value in (("batch_size", batch_size), ("workers", workers)):
        if value is not None and value < 1:
            raise ExecutorError(f"{name} is {value}; use a whole number of at least 1")
    for name, value, known in (
        ("keep", keep, ("summary", "diagonal", "full")),
        ("dtype", dtype, ("float64", "float32")),
    ):
        if value not in known:
            raise StoreError(f"{name} is {value!r}; use one of {', '.join(known)}")
    if out is None and (resume or shard is not None):
        raise StoreError("resume and shard need a folder to go on with; name it with --out")
    resolved = resolve(scenario, estimators, runs, seed, duration, overrides)
    prepared = setup.build(resolved)
    using = executors.pool(executor, workers or executors.cpu_count(), address)
    size = batch_size or default_batch_size(prepared, keep)
    if out is None:
        count = resolved.simulation.runs
        batches = [range(i, min(i + size, count)) for i in range(0, count, size)]
        done, failed, interrupted = _compute(prepared, batches, keep, using, None, {}, progress)
        return _collect(prepared, batches, done, failed, None, interrupted)
    folder = Path(out)
    target = _open(folder, prepared, keep, size, dtype, resume, shard)
    with target.lock(shard):
        done, corrupted = _finished(target)
        indices = range(len(target.batches)) if shard is None else _share(target, shard)
        wanted = {i: target.batches[i] for i in indices if i not in done}
        done, failed, interrupted = _compute(
            prepared, wanted, target.keep, using, target, done, progress
        )
        if interrupted:  # a worker may have written what it had no time to report
            done = {**_finished(target)[0], **done}
        if not done:
            target.discard()
        else:
            target.close()
    return _collect(
        prepared, target.batches, done, failed, target, interrupted,
        [f"batch {i} of the store was corrupted and has been computed again" for i in corrupted],
    )  # fmt: skip


def _open(
    folder: Path,
    prepared: setup.Setup,
    keep: str,
    size: int,
    dtype: str,
    resume: bool,
    shard: tuple[int, int] | None,
) -> store.Store:
    """A new store, or the one to go on with; of several shards the first comer makes it."""
    if (resume or shard is not None) and folder.exists():
        return store.Store.reopen(folder, prepared)
    try:
        return store.Store.create(folder, prepared, keep, size, dtype)
    except StoreError:
        if shard is None or not folder.exists():
            raise
        return store.Store.reopen(folder, prepared)


def _share(target: store.Store, shard: tuple[int, int]) -> range:
    return range(shard[0] - 1, len(target.batches), shard[1])


def _finished(target: store.Store) -> tuple[dict[int, dict[str, records.Record]], list[int]]:
    """Summary records of the batches that are done, and the batches found corrupted."""
    done, corrupted = {}, []
    for index in range(len(target.batches)):
        if target.finished(index):
            found = target.read(index)
            if found is None:
                corrupted.append(index)
            else:
                done[index] = found
    return done, corrupted


def _compute(
    prepared: setup.Setup,
    batches: Mapping[int, range] | Sequence[range],
    keep: str,
    using: executors.Pool,
    target: store.Store | None,
    done: dict[int, dict[str, records.Record]],
    progress: Progress | None,
) -> tuple[dict[int, dict[str, records.Record]], dict[int, Exception], bool]:
    """Compute batches: the summary records, what failed, and whether Ctrl-C came."""
    chosen = dict(enumerate(batches)) if not isinstance(batches, Mapping) else dict(batches)
    toml = prepared.scenario.to_toml()
    folder = None if target is None else str(target.folder.resolve())
    tasks = [worker.Task(toml, keep, folder, i, (r.start, r.stop)) for i, r in chosen.items()]
    failed: dict[int, Exception] = {}
    total, finished = sum(map(len, chosen.values())), 0
    stopping = threading.Event()
    work = partial(worker.work, stop=stopping.is_set) if using.local else worker.work
    try:
        for outcome in executors.execute(work, tasks, using, stopping.set):
            if isinstance(outcome, executors.Failed):
                if not done and not isinstance(outcome.error, ExecutorError):
                    raise outcome.error  # nothing works: the input is at fault, not one batch
                failed[outcome.task.index] = outcome.error
                continue
            task, result = outcome
            if result is None:
                continue
            done[task.index] = result
            finished += len(chosen[task.index])
            if progress is not None:
                progress(finished, total)
    except KeyboardInterrupt:
        return done, failed, True
    except BaseException:
        if target is not None and not done:
            target.discard()
        raise
    return done, failed, False


def resolve(
    scenario: str | Path | scenarios.Scenario,
    estimators: Sequence[str] | None = None,
    runs: int | None = None,
    seed: int | None = None,
    duration: float | None = None,
    overrides: Sequence[str] = (),
) -> scenarios.Scenario:
    """The scenario with the arguments of `run` applied."""
    simulation = {"runs": runs, "seed": seed, "duration": duration}
    overrides = [f"simulation.{k}={v}" for k, v in simulation.items() if v is not None] + [
        *overrides
    ]
    if isinstance(scenario, scenarios.Scenario):
        resolved = scenarios.override(scenario, overrides)
    else:
        resolved = scenarios.load(scenario, overrides)
    if estimators:
        known = dict(resolved.estimators)
        chosen = {}
        for name in estimators:
            label = name.rpartition(":")[2] if ":" in name else name
            if label in chosen:
                raise EstimatorError(f"estimator '{label}' is named twice; give each its own label")
            chosen[label] = known.get(name, {} if label == name else {"type": name})
            if name not in known and ":" not in name and name not in registry.known():
                hint = did_you_mean(name, {**registry.known(), **known})
                raise EstimatorError(f"no estimator '{name}'{hint}")
        resolved = resolved.model_copy(update={"estimators": chosen})
    if "truth" in resolved.estimators:
        raise ScenarioError("estimators.truth: the label 'truth' is taken; choose another")
    return resolved


def default_batch_size(prepared: setup.Setup, keep: str) -> int:
    """Runs a batch: what fits `BATCH_BYTES`, at most 250 (caches), else a quarter of the runs.

    It does not depend on the machine, so neither do the results, to the last bit.
    """
    space, runs = prepared.space, prepared.scenario.simulation.runs
    a_step = 2 * space.nx + 3 * space.n + 4 + (space.n**2 if keep == "full" else 0)
    a_run = 8 * a_step * len(prepared.times) * max(1, len(prepared.scenario.estimators))
    return int(np.clip(BATCH_BYTES // a_run, 1, min(250, max(10, -(-runs // 4)))))


def run_batch(
    prepared: setup.Setup, runs: Sequence[int], keep: str, stop: Callable[[], bool] = lambda: False
) -> Batch | None:
    """Simulate some runs and every estimator on them; None when stopped."""
    out = {}
    truth: records.Record = {}
    for label, traces in traced(prepared, runs, keep == "full", stop):
        if traces is None:
            return None
        section = prepared.scenario.consistency
        out[label] = records.reduce(traces, prepared.times, section, keep)
        if keep != "summary":
            x = {"x": np.swapaxes(traces.truth, 0, 1)}
            if prepared.scenario.control.observe == "estimate":
                out[label] |= x
            else:
                truth = x
    return Batch(truth, out)


def traced(
    prepared: setup.Setup,
    runs: Sequence[int],
    keep_cov: bool = False,
    stop: Callable[[], bool] = lambda: False,
) -> Iterator[tuple[str, Traces | None]]:
    """The traces of each estimator on some runs, one estimator after the other."""
    period = prepared.plant.period
    live = prepared.scenario.control.observe == "estimate"
    trajectory: Trajectory | None = None
    if not live:
        trajectory = simulate(prepared.simulator(runs), prepared.controller(runs), period)
    for label in prepared.scenario.estimators:
        source = (
            Recorded(prepared.instants, trajectory)
            if trajectory is not None
            else Live(prepared.simulator(runs), prepared.controller(runs), period)
        )
        mean, cov = (np.repeat(a[None], len(runs), axis=0) for a in prepared.prior(label))
        keys = streams.run_keys(prepared.scenario.simulation.seed, runs, f"estimator:{label}")
        try:
            traces = run_filter(
                prepared.estimator(label), prepared.space, (mean, cov), source,
                prepared.channel_spaces,
                delays=prepared.delays(label), keys=keys, keep_cov=keep_cov, stop=stop,
            )  # fmt: skip
        except EstbenchError:
            raise
        except Exception as error:  # a user's estimator may raise anything
            raise EstimatorError(f"{label} raised {type(error).__name__}: {error}") from error
        yield label, traces
        if traces is None:
            return


def _collect(
    prepared: setup.Setup,
    batches: Sequence[range],
    done: dict[int, dict[str, records.Record]],
    failed: dict[int, Exception],
    target: store.Store | None,
    interrupted: bool,
    notices: Sequence[str] = (),
) -> Results:
    """The results of the batches that are done."""
    if not done and failed:
        raise next(iter(failed.values()))
    if not done:
        raise Interrupted("interrupted before the first batch was finished: there is no result")
    order = sorted(done)
    runs = [run for i in order for run in batches[i]]
    merged = {
        label: records.merge([done[i][label] for i in order])
        for label in prepared.scenario.estimators
    }
    section = prepared.scenario.consistency
    return Results(
        scenario=prepared.scenario,
        names=prepared.space.names,
        units=prepared.space.units,
        times=prepared.times,
        runs=tuple(runs),
        summaries=tuple(
            statistics.summarize(label, record, runs, prepared.times, section)
            for label, record in merged.items()
        ),
        records=merged,
        notices=(
            *prepared.notices,
            *notices,
            *(
                f"runs {batches[i].start}-{batches[i].stop - 1} are missing: {error}"
                for i, error in sorted(failed.items())
            ),
        ),
        folder=target.folder if target is not None else None,
        interrupted=interrupted,
    )
