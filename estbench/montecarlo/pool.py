"""A pool of workers, and the loop that runs tasks on one: threads, processes, or a dask cluster.

The three have one interface, `concurrent.futures.Executor`. A task whose worker dies is tried again
alone, and reported if it kills its worker each time, while the others complete. A task that runs
out of memory is tried again in the same way, while no other task takes any.
"""

import threading
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, wait
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

from estbench.errors import ExecutorError
from estbench.montecarlo.team import WorkerDiedError
from estbench.spaces.blas import one_thread

T = TypeVar("T")
POLL = 1.0
"""Seconds between two checks whether a cluster is still there."""


@dataclass(frozen=True)
class Failed(Generic[T]):
    """A task without a result, and its error."""

    task: T
    error: Exception


@dataclass(frozen=True)
class Pool:
    """How to make an executor, how many tasks it runs at once, and how to abandon it."""

    make: Callable[[], Executor]
    workers: int
    abandon: Callable[[Executor], None]
    queue: int
    """Tasks submitted at once."""
    lost: Callable[[], bool] = lambda: False
    """Whether the workers are gone although their futures do not end."""
    kept: bool = False
    """Whether the executor outlives the tasks that it was made for."""


@contextmanager
def keeping(using: Pool) -> Iterator[Pool]:
    """A pool of which one executor works off all tasks within the block; others end it.

    Args:
        using: the workers.
    """
    if using.kept:
        yield using
        return
    living: list[Executor] = []

    def make() -> Executor:
        if not living:
            living.append(using.make())
        return living[0]

    def abandon(executor: Executor) -> None:
        living.clear()
        using.abandon(executor)

    try:
        yield replace(using, make=make, abandon=abandon, kept=True)
    finally:
        for executor in living:
            executor.shutdown(wait=True)
            using.abandon(executor)


@dataclass(frozen=True)
class _Here:
    """A function with what its tasks share in this process; another process gets it bare."""

    function: Callable[..., Any]
    stop: Callable[[], bool]
    prepared: Any

    def __call__(self, task: Any) -> Any:
        return self.function(task, stop=self.stop, prepared=self.prepared)

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return _bare, (self.function,)


def _bare(function: Callable[..., Any]) -> Callable[..., Any]:
    return function


def work_off(
    function: Callable[..., Any],
    tasks: Sequence[T],
    using: Pool,
    prepared: Any,
    finished: Callable[[T, Any], None],
    failed: Callable[[T, Exception], None],
) -> bool:
    """Run tasks to their end, or to Ctrl-C.

    Args:
        function: called with each task, in this process also with `stop` and `prepared`; it returns
            the task and its result, None when stopped.
        tasks: see `execute`.
        using: the workers.
        prepared: what workers in this process need not build again.
        finished: called with each task that has a result.
        failed: called with each task that has none, and its error.

    Returns:
        Whether Ctrl-C came.
    """
    stopping = threading.Event()
    here = _Here(function, stopping.is_set, prepared)
    try:
        with one_thread(), closing(execute(here, tasks, using, stopping.set)) as outcomes:
            for outcome in outcomes:
                if isinstance(outcome, Failed):
                    failed(outcome.task, outcome.error)
                elif outcome[1] is not None:
                    finished(*outcome)
    except KeyboardInterrupt:
        return True
    return False


def execute(
    function: Callable[[T], Any],
    tasks: Sequence[T],
    using: Pool,
    stop: Callable[[], None] = lambda: None,
    retries: int = 2,
) -> Generator[tuple[T, Any] | Failed[T], None, None]:
    """Results in the order of completion; a task that raised or whose worker died is `Failed`.

    Args:
        function: called with each task; for processes it must be importable.
        tasks: hashable.
        using: the workers, from `executors.pool`.
        stop: called if the loop is left early, before the executor is abandoned.
        retries: how often a task whose worker died is run again, alone.
    """
    fresh, suspects = deque(tasks), deque[T]()
    deaths: Counter[T] = Counter()
    waiting: dict[Future[Any], T] = {}
    succeeded = False
    executor = using.make()
    try:
        while fresh or suspects or waiting:
            # Suspects run alone, after the others: if a worker dies again, the task is known. As
            # long as no task has succeeded they run first, so that a hopeless run ends soon.
            alone = bool(suspects) and not (fresh and succeeded)
            source, limit = (suspects, 1) if alone else (fresh, using.queue)
            while source and len(waiting) < limit:
                task = source.popleft()
                try:
                    waiting[executor.submit(function, task)] = task
                except Exception as error:  # a lost cluster accepts no tasks
                    yield Failed(task, ExecutorError(f"{LOST} ({type(error).__name__}: {error})"))
            finished, _ = wait(waiting, POLL, FIRST_COMPLETED) if waiting else ((), ())
            if not finished and using.lost():  # its futures would never end
                for task in (*waiting.values(), *suspects, *fresh):
                    yield Failed(task, ExecutorError(LOST))
                using.abandon(executor)
                return
            lost: dict[T, str] = {}
            for future in finished:
                task = waiting.pop(future)
                try:
                    result = future.result()
                except WorkerDiedError:
                    lost[task] = DIED
                except MemoryError:
                    lost[task] = NO_MEMORY
                except Exception as error:  # what the task raised is its failure
                    yield Failed(task, _ours(error))
                else:
                    succeeded = True
                    yield task, result
            for task, reason in lost.items():
                deaths[task] += 1
                if deaths[task] <= retries:
                    suspects.append(task)
                else:
                    yield Failed(task, ExecutorError(reason.format(deaths[task])))
    except BaseException:
        stop()
        using.abandon(executor)
        raise
    if not using.kept:
        executor.shutdown(wait=True)
        using.abandon(executor)  # a cluster's connection is left open otherwise


DIED = "the worker died {} times (out of memory? killed?); take fewer --workers"
NO_MEMORY = "no memory, {} times, alone too; take --keep summary, or fewer estimators at once"
LOST = "the cluster was lost; go on with --resume"


def _ours(error: Exception) -> Exception:
    """The error of a task, with a clear message where a cluster lost it."""
    if isinstance(error, CancelledError):
        return ExecutorError(LOST)
    if type(error).__name__ == "KilledWorker":  # distributed.scheduler.KilledWorker
        return ExecutorError(f"the workers that computed it died: {error}")
    return error
