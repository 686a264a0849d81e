"""What a computation will take, found before it begins: time and memory."""

import time
from dataclasses import dataclass, replace

import numpy as np

from estbench.bounds import scenario as bounds
from estbench.errors import EstbenchError
from estbench.experiment.prepared import Setup
from estbench.experiment.size import free_memory
from estbench.montecarlo import batch, executors
from estbench.robots import unlocked
from estbench.shapes import Array
from estbench.tables.durations import duration

LONG = 60.0
"""Seconds from which a computation is worth a line."""
LARGE = 4 * 2**30
"""Bytes from which its memory is."""
_SHORT = 1_000_000
"""Evaluations of the model below which a run is short on any machine; nothing is measured then."""
_WIDE = 500
"""Values of one measurement from which the factorization of S dominates."""
_INSTANTS = 2, 6
_MORE = 2, 18
_RUNS = 1, 8
"""Two counts each, whose difference leaves out what is done once; `_MORE` instants at last, as
what is done once for a batch takes as long as ten instants."""
_PROBE = 0.01
"""Seconds of an instant of the last measurement, of as many runs as take that long, or a batch."""
_SLOW = 0.05
"""Seconds of a step of one run from which a batch of many runs is not measured: what is done once
for a batch is then a small part, and the measurement would take a minute."""


@dataclass(frozen=True)
class Forecast:
    """Time and memory of a computation.

    Attributes:
        seconds: of all batches.
        step: seconds of one step of one run, over all estimators.
        memory: bytes that the workers take together.
        free: bytes that are free; None where it is not known.
        locked: share of the time outside of MuJoCo, under the interpreter's lock; None where it was
            not measured.
    """

    seconds: float
    step: float
    memory: int
    free: int | None = None
    locked: float | None = None

    @property
    def line(self) -> str:
        """One line if it takes long or much memory, else empty."""
        fits = self.free is None or self.memory <= self.free
        if self.seconds < LONG and self.memory < LARGE and fits:
            return ""
        time = ""
        if self.step:
            each = f"{1e3 * self.step:.2g} ms per run and step"
            time = f"about {duration(self.seconds)} ({each}) and "
        line = f"this will take {time}about {self.memory / 2**30:.2g} GiB"
        if not fits and self.free is not None:
            return (
                f"{line}, and {self.free / 2**30:.2g} GiB are free: it may not fit; --keep "
                "summary, fewer --workers, a shorter duration, or a smoother's window take less"
            )
        return f"{line}; fewer runs, a shorter duration or fewer estimators cost less"


def lines(
    prepared: Setup,
    size: int,
    keep: str,
    workers: int,
    hidden: str = "",
    found: Forecast | None = None,
) -> list[str]:
    """What to say before the runs of an experiment that takes long are computed.

    Args:
        prepared: the experiment.
        size: runs of one batch.
        keep: what is stored of each.
        workers: threads or processes.
        hidden: what no sensor sees, which is worth a line then.
        found: the forecast, if it has been made.
    """
    runs = prepared.scenario.simulation.runs
    found = found or forecast(prepared, runs, size, keep, workers)
    out = [*wide_channels(prepared), *([found.line] if found.line else [])]
    return [*out, *([hidden] if out and hidden else [])]


def wide_channels(prepared: Setup) -> list[str]:
    """One line for each channel of so many values that it decides what an update costs."""
    return [
        f"{name} has {space.n} values: each update factorizes a {space.n} x {space.n} S, "
        f"{duration(_factorization(space.n))} in each run; sensors = [...] leaves it out"
        for name, space in prepared.channel_spaces.items()
        if space.n >= _WIDE
    ]


def forecast(prepared: Setup, runs: int, size: int, keep: str, workers: int) -> Forecast:
    """Measure the first steps of a few runs, and extrapolate; no time for what is short anyway.

    Args:
        prepared: the experiment.
        runs: how many are to be computed.
        size: runs of one batch.
        keep: what is stored of each.
        workers: threads or processes; at most one per CPU, and one per batch, count.
    """
    size = min(size, runs)
    workers = min(workers, executors.cpu_count(), -(-runs // size))
    steps, count = len(prepared.instants), max(1, len(prepared.scenario.estimators))
    memory = workers * batch.held_bytes(prepared, keep, size)
    free = free_memory()
    width = max(space.n for space in prepared.channel_spaces.values())
    if width >= _WIDE:
        step = count * _factorization(width)
        return Forecast(runs * steps * step / workers, step, memory, free)
    if evaluations(prepared, runs) < _SHORT:
        return Forecast(0.0, 0.0, memory, free)
    try:
        each = one = _step(prepared, _RUNS[0])
        if one.sum() < _SLOW:
            more = _step(prepared, _RUNS[1])
            each = np.maximum(more - one, 0.0) / (_RUNS[1] - _RUNS[0])
        parts = np.maximum(one - each, 0.0) / size + each
        rows = int(np.clip(_PROBE / max(parts.sum(), 1e-9), 1, size))
        if rows > _RUNS[1]:  # as in a batch: what a few runs take differs from it
            parts = _step(prepared, rows, _MORE) / rows
    except EstbenchError:  # told when the runs are computed
        return Forecast(0.0, 0.0, memory, free)
    step = float(parts.sum())
    locked = float(parts[0]) / step if step else None
    return Forecast(runs * steps * step / workers, step, memory, free, locked)


def evaluations(prepared: Setup, runs: int) -> int:
    """Steps of the model that the estimators take with points on both sides of each coordinate."""
    count = max(1, len(prepared.scenario.estimators))
    return runs * len(prepared.instants) * count * (2 * prepared.space.n + 1)


def _step(prepared: Setup, rows: int, instants: tuple[int, int] = _INSTANTS) -> Array:
    """Seconds of one instant of so many runs, under the interpreter's lock and without it."""
    first, few, more = (_seconds(prepared, rows, count) for count in (instants[0], *instants))
    few = np.minimum(first, few)  # the first takes memory; what other threads do is in either
    return np.maximum(more - few, 0.0) / (instants[1] - instants[0])


def _seconds(prepared: Setup, rows: int, instants: int) -> Array:
    """CPU time of the first instants of some runs, under the interpreter's lock and without it."""
    short = replace(prepared, instants=prepared.instants[:instants])
    began = time.process_time()
    with unlocked.counted() as without:
        for _ in batch.traced(short, range(rows), bounded=bounds.wanted(prepared)):
            pass
    return np.array([time.process_time() - began - without.seconds, without.seconds])


def _factorization(m: int) -> float:
    """Seconds of an update of m values: some six Cholesky factorizations, of m³/3 each."""
    few, taken = np.eye(200), []
    for _ in range(5):
        began = time.process_time()
        np.linalg.cholesky(few)
        taken.append(time.process_time() - began)
    return 6 * min(taken) * (m / len(few)) ** 3
