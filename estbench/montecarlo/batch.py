"""One batch of runs: its size, the truth, every estimator on it, and what is kept of them."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estbench.bounds import scenario as bounds
from estbench.consistency import records
from estbench.experiment import contact, long, setup
from estbench.experiment.recording import blamed, estimated, recorded
from estbench.inference.innovations import readings
from estbench.inference.traces import Traces
from estbench.montecarlo import windows

BATCH_BYTES = 64 * 2**20
"""Memory that the traces of one batch may take."""
WORKING_BYTES = 2**30
"""Memory that the computation of one instant of a batch may take."""
TRACES_BYTES = 2**30
"""Traces of a whole experiment above which they are stored only when asked for."""
INSTANT_BYTES = 800
"""Memory of an instant of a batch, whatever its runs: its times, controls and deliveries."""
COPIES = 4
"""Size of all that exists at once of a batch, its truth and the reduction of its traces included,
over that of the traces."""
LONG_INSTANT_BYTES = 80
"""Memory of an instant of a long run that is computed window after window: its ticks and times."""


@dataclass(frozen=True, eq=False)
class Batch:
    """What one batch of runs gave: the true states and one record per estimator."""

    truth: records.Record
    records: dict[str, records.Record]


def trace_bytes(prepared: setup.Setup, dtype: str = "float64", keep: str = "diagonal") -> int:
    """What `diagonal` or `full` stores beyond `summary`, for all runs and estimators."""
    space, count = prepared.space, len(prepared.scenario.estimators)
    live = prepared.scenario.control.observe == "estimate"
    numbers = count * (space.nx + 2 * space.n + 2) + space.nx * (count if live else 1)
    if keep == "full":
        m = len(readings(prepared.channel_spaces))
        numbers += count * (space.n**2 + m + m**2)
    whole = 2 * 8 * count  # the degrees of freedom of NEES and of NIS
    a_step = numbers * np.dtype(dtype).itemsize + whole
    return a_step * len(prepared.times) * prepared.scenario.simulation.runs


def default_keep(prepared: setup.Setup, dtype: str = "float64") -> str:
    """`diagonal` while the traces take at most `TRACES_BYTES`, else `summary`."""
    return "diagonal" if trace_bytes(prepared, dtype) <= TRACES_BYTES else "summary"


def default_batch_size(prepared: setup.Setup, keep: str, parts: int = 4) -> int:
    """Runs per batch: what fits the memory, at most 250 (caches), else a part of the runs.

    The memory is `BATCH_BYTES` of traces and `WORKING_BYTES` of an instant. The batches are a
    multiple of `parts` and nearly equal, so that the cores finish together; 10 runs are not
    divided. It does not depend on the machine, so neither do the results, to the last bit.
    """
    runs = prepared.scenario.simulation.runs
    most = BATCH_BYTES // run_bytes(prepared, keep)
    most = min(most, WORKING_BYTES // working_bytes(prepared))
    size = int(np.clip(most, 1, min(250, max(10, -(-runs // parts)))))
    rounds = -(-runs // (size * parts))
    return max(min(size, 10), -(-runs // (rounds * parts)))


def run_bytes(prepared: setup.Setup, keep: str) -> int:
    """Memory of the traces of one run, of a long one those of a window and of the sample."""
    space, m = prepared.space, len(readings(prepared.channel_spaces))
    a_step = 2 * space.nx + 3 * space.n + 4
    if keep == "full":
        a_step += space.n**2 + m + m**2
    held = long.held_instants(prepared, keep)
    return 8 * a_step * held * max(1, len(prepared.scenario.estimators))


def held_bytes(prepared: setup.Setup, keep: str, size: int) -> int:
    """Memory of a batch while it is computed, measured to some 30% (docs/performance.md).

    Args:
        prepared: the experiment.
        keep: what is stored of each run; with `summary` one estimator has its traces at a time.
        size: runs of the batch.
    """
    count, windowed = len(prepared.scenario.estimators), long.windowed(prepared, keep)
    together = max(1, count) if keep == "summary" and not windowed else 1
    a_run = COPIES * run_bytes(prepared, keep) // together
    a_run += working_bytes(prepared) + history_bytes(prepared)
    each, instants = (LONG_INSTANT_BYTES, 2 * long.WINDOW) if windowed else (0, len(prepared.times))
    return size * a_run + INSTANT_BYTES * instants + each * len(prepared.times)


def history_bytes(prepared: setup.Setup) -> int:
    """Memory of what a smoother looks back on in one run, the largest of those of all estimators.

    The filtered and the smoothed mean and covariance, and the measurement, at each time of the run
    or of a window.
    """
    space, m = prepared.space, len(readings(prepared.channel_spaces))
    shares = [0.0]
    for label in prepared.scenario.estimators:
        estimator = prepared.estimator(label)
        if hasattr(estimator, "smooth"):
            window = getattr(estimator, "window", None) or np.inf
            shares.append(min(1.0, window / prepared.times[-1]))
    return int(8 * (2 * (space.nx + space.n**2) + m) * len(prepared.times) * max(shares))


def working_bytes(prepared: setup.Setup) -> int:
    """Memory of one instant of one run: covariances, their factors, and points about the mean."""
    space, m = prepared.space, len(readings(prepared.channel_spaces))
    return 8 * (4 * m**2 + 8 * space.n**2 + (2 * space.n + 1) * (space.nx + m))


def run_batch(
    prepared: setup.Setup, runs: Sequence[int], keep: str, stop: Callable[[], bool] = lambda: False
) -> Batch | None:
    """Simulate some runs and every estimator on them; None when stopped."""
    if long.windowed(prepared, keep):
        found = windows.run_batch(prepared, runs, stop)
        return None if found is None else Batch({}, found)
    out, contacts = {}, None
    own_truth = prepared.scenario.control.observe == "estimate"
    truth: records.Record = {}
    full = keep == "full"
    for label, traces in traced(prepared, runs, full, full, stop, bounds.wanted(prepared)):
        if traces is None:
            return None
        section = prepared.scenario.consistency
        if not out or own_truth:
            contacts = contact.seen(prepared, traces.truth, runs)
        phases = None if contacts is None else contacts.phases
        out[label] = records.reduce(traces, prepared.times, section, keep, phases)
        if keep != "summary":
            x = {"x": np.swapaxes(traces.truth, 0, 1)}
            if own_truth:
                out[label] |= x
            else:
                truth = x
    return Batch(truth, out)


def traced(
    prepared: setup.Setup,
    runs: Sequence[int],
    keep_cov: bool = False,
    keep_innovations: bool = False,
    stop: Callable[[], bool] = lambda: False,
    bounded: bool = False,
) -> Iterator[tuple[str, Traces | None]]:
    """The traces of each estimator on some runs, one after the other; None ends it: stopped.

    An estimator that is the scenario's reference has followed the runs already. With `bounded` the
    traces have the bound of these runs, the same for all estimators that share a truth.
    """
    keep = keep_cov, keep_innovations, stop
    own_truth = prepared.scenario.control.observe == "estimate"
    found = None if own_truth else recorded(prepared, runs, *keep)
    if found is None and not own_truth:
        yield next(iter(prepared.scenario.estimators)), None
        return
    truth, reference = found or (None, None)
    bound = None
    if bounded and truth is not None:
        bound = bounds.bound_of_runs(prepared, runs, truth, stop)
    for label in prepared.scenario.estimators:
        traces = None
        if reference is not None and prepared.is_reference(label):
            traces = blamed(reference, truth and truth.lost)
        elif followed := estimated(prepared, label, runs, truth, *keep):
            traces, own = followed
            if bounded and truth is None:
                bound = bounds.bound_of_runs(prepared, runs, own, stop)
        yield label, traces and replace(traces, bound=bound)
        if traces is None:
            return
