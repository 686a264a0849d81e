"""Monte Carlo: many runs in batches on worker threads, interruptible, every finished run kept."""

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from estbench import records, setup, statistics, store, streams
from estbench import scenario as scenarios
from estbench.errors import EstbenchError, EstimatorError, ScenarioError, did_you_mean
from estbench.estimators import registry
from estbench.filtering import Live, Recorded, Traces, run_filter
from estbench.models.rows import engine
from estbench.results import Results
from estbench.truth import Trajectory, simulate

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]
"""Called with the runs done and the runs in all."""

BATCH_BYTES = 64 * 2**20
"""Memory that the traces of one batch may take."""


@dataclass(frozen=True, eq=False)
class Batch:
    """What one batch of runs gave."""

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
    threads: int | None = None,
    batch_size: int | None = None,
    progress: Progress | None = None,
) -> Results:
    """Simulate, observe, estimate, compare.

    Args:
        scenario: a bundled name, a TOML or MJCF path, a results folder, or a `Scenario`.
        estimators: labels or names to run in place of the scenario's.
        runs, seed, duration: in place of the scenario's; duration in s.
        overrides: `section.key=value` strings.
        out: folder to write the results to; None writes nothing.
        keep: what the store keeps of every run.
        threads: worker threads; default the CPUs this process may use.
        batch_size: runs a batch; default by memory. It does not change the results.
        progress: called after every batch.

    Returns:
        The results; `print` shows the tables. After Ctrl-C those of the finished runs.

    Raises:
        EstbenchError: anything wrong with the input, before anything is written.
    """
    resolved = resolve(scenario, estimators, runs, seed, duration, overrides)
    prepared = setup.build(resolved)
    size = batch_size or default_batch_size(prepared, keep)
    count = resolved.simulation.runs
    batches = [range(start, min(start + size, count)) for start in range(0, count, size)]
    target = store.Store(Path(out), prepared, keep, batches) if out is not None else None
    done: dict[int, Batch] = {}
    interrupted = False
    try:
        for index, result in _execute(prepared, batches, keep, threads or cpu_count()):
            if target is not None:
                runs_of = batches[index]
                target.write(
                    index, slice(runs_of[0], runs_of[-1] + 1), result.truth, result.records
                )
            done[index] = Batch({}, {k: _summary(r) for k, r in result.records.items()})
            if progress is not None:
                progress(sum(len(batches[i]) for i in done), count)
    except KeyboardInterrupt:
        interrupted = True
    finally:
        if target is not None:
            target.close() if done else target.discard()
    if not done:
        raise EstbenchError("interrupted before the first batch was finished: there is no result")
    return _collect(prepared, batches, done, target, interrupted)


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


def cpu_count() -> int:
    """CPUs this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


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
            truth = {"x": np.swapaxes(traces.truth, 0, 1)}
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
    n = prepared.space.n
    prior = (
        np.broadcast_to(prepared.mean, (len(runs), prepared.mean.size)).copy(),
        np.broadcast_to(prepared.cov, (len(runs), n, n)).copy(),
    )
    for label in prepared.scenario.estimators:
        source = (
            Recorded(prepared.instants, trajectory)
            if trajectory is not None
            else Live(prepared.simulator(runs), prepared.controller(runs), period)
        )
        keys = streams.run_keys(prepared.scenario.simulation.seed, runs, f"estimator:{label}")
        try:
            traces = run_filter(
                prepared.estimator(label), prepared.space, prior, source, prepared.channel_spaces,
                delays=prepared.delays(label), keys=keys, keep_cov=keep_cov, stop=stop,
            )  # fmt: skip
        except EstbenchError:
            raise
        except Exception as error:  # a user's estimator may raise anything
            raise EstimatorError(f"{label} raised {type(error).__name__}: {error}") from error
        yield label, traces
        if traces is None:
            return


def _execute(
    prepared: setup.Setup, batches: Sequence[Sequence[int]], keep: str, threads: int
) -> Iterator[tuple[int, Batch]]:
    """Batches as they finish; at most two a thread are in memory at once."""
    stopping = threading.Event()
    with engine(), _pool(threads, stopping) as pool:
        waiting: dict[Future[Batch | None], int] = {}
        queue = iter(enumerate(batches))
        while True:
            for index, runs in queue:
                waiting[pool.submit(run_batch, prepared, runs, keep, stopping.is_set)] = index
                if len(waiting) >= 2 * threads:
                    break
            if not waiting:
                return
            finished, _ = wait(waiting, return_when=FIRST_COMPLETED)
            for future in finished:
                result = future.result()
                if result is not None:
                    yield waiting[future], result
                del waiting[future]


@contextmanager
def _pool(threads: int, stopping: threading.Event) -> Iterator[ThreadPoolExecutor]:
    """A thread pool whose workers are asked to stop when the block is left."""
    pool = ThreadPoolExecutor(threads, thread_name_prefix="estbench")
    try:
        yield pool
    finally:
        stopping.set()
        pool.shutdown(wait=True, cancel_futures=True)


def _summary(record: records.Record) -> records.Record:
    return {name: record[name] for name in records.SUMMARY}


def _collect(
    prepared: setup.Setup,
    batches: Sequence[Sequence[int]],
    done: dict[int, Batch],
    target: store.Store | None,
    interrupted: bool,
) -> Results:
    order = sorted(done)
    runs = [run for i in order for run in batches[i]]
    merged = {
        label: records.merge([done[i].records[label] for i in order])
        for label in prepared.scenario.estimators
    }
    summaries = tuple(
        statistics.summarize(label, record, runs, prepared.times, prepared.scenario.consistency)
        for label, record in merged.items()
    )
    return Results(
        scenario=prepared.scenario,
        names=prepared.space.names,
        units=prepared.space.units,
        times=prepared.times,
        runs=tuple(runs),
        summaries=summaries,
        records=merged,
        notices=prepared.notices,
        folder=target.folder if target is not None else None,
        interrupted=interrupted,
    )
