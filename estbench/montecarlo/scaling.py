"""Threads or processes: which of them would finish first, from what was measured of the work.

Threads start at once, but wait for each other wherever they hold the interpreter's lock. A spawned
process has a lock of its own, and takes seconds to start.
"""

from estbench.experiment.prepared import Setup
from estbench.montecarlo import batch, executors, team
from estbench.montecarlo.forecast import Forecast, evaluations, forecast
from estbench.montecarlo.pool import Pool

START = 0.8
"""CPU seconds in which a spawned process has imported what it needs and compiled a model."""
LONG = 5_000_000
"""Evaluations of the model from which on processes start while the forecast is made: those of the
cheapest robot take five seconds, of which two cores save as much as the start takes."""


def pool(
    kind: str,
    prepared: Setup,
    runs: int,
    size: int,
    keep: str,
    workers: int | None,
    address: str | None,
) -> tuple[Pool, Forecast | None]:
    """The pool of a kind, where `auto` is decided by a forecast, and that forecast.

    Args:
        kind: one of `executors.KINDS`.
        prepared: the experiment.
        runs: how many are to be computed.
        size: runs of one batch.
        keep: what is stored of each.
        workers: count, no more than batches; default as many as fit the machine. `auto` has no
            more than CPUs, where more would wait for each other.
        address: of the dask scheduler.
    """
    held, batches = batch.held_bytes(prepared, keep, min(size, runs)), -(-runs // size)
    found = None
    if kind == "auto":
        workers = min(workers or executors.fitting("both", held), executors.cpu_count(), batches)
        starts = 0.0 if team.stands(1, workers - 1) else (workers - 1) * START
        if workers > 1 and evaluations(prepared, runs) >= LONG:
            team.kept(1, workers - 1)
        found = forecast(prepared, runs, size, keep, workers)
        kind = choose(found, workers, executors.cpu_count(), starts)
    workers = min(workers or executors.fitting(kind, held), batches)
    return executors.pool(kind, workers, address), found


def choose(found: Forecast, workers: int, cpus: int, starts: float) -> str:
    """What `auto` means: `threads`, or `both`, this process and `workers - 1` spawned ones.

    Args:
        found: time of all batches if the cores shared it evenly, and share under the lock.
        workers: that compute at once.
        cpus: which they share.
        starts: CPU seconds in which the spawned ones start; 0 if they stand from before.
    """
    if workers < 2 or found.locked is None:
        return "threads"
    cores = min(workers, cpus)
    work = found.seconds * cores
    apart = (work + starts) / cores
    threads = work / min(cores, thread_speed(found.locked, workers))
    return "both" if apart < threads else "threads"


def thread_speed(locked: float, threads: int) -> float:
    """Speed of threads over that of one, that wait in a queue for the lock.

    With a share s of the work under the lock, of which Q_(n-1) others hold or await it when one of
    n threads comes: R_n = s (1 + Q_(n-1)), X_n = n / (1 - s + R_n), Q_n = X_n R_n. For many threads
    it tends to 1 / s. Mean value analysis of a closed queue, Reiser and Lavenberg, Journal of the
    ACM 27 (1980), 313-322.

    Args:
        locked: share of one thread's time under the lock.
        threads: count.
    """
    speed = queued = 0.0
    for n in range(1, threads + 1):
        held = locked * (1 + queued)
        speed = n / (1 - locked + held)
        queued = speed * held
    return speed
