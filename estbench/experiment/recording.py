"""The truth of some runs, and an estimator that follows it: who the controller sees decides how."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from estbench.errors import EstbenchError, EstimatorError, user_error_location
from estbench.estimators.beliefs import Fault
from estbench.experiment.prepared import Setup
from estbench.inference import event_loop
from estbench.inference.event_loop import Source
from estbench.inference.traces import Traces
from estbench.randomness import streams
from estbench.scenario.reference import LABEL
from estbench.shapes import Bool, Mask
from estbench.simulation.sources import Live, Noting, Recorded, Trajectory, record

Stop = Callable[[], bool]


def driven(prepared: Setup, runs: Sequence[int]) -> Live:
    """The robots of some runs at their start, under the scenario's controller."""
    controller, period = prepared.controller(runs), prepared.plant.period
    return Live(prepared.simulator(runs), prepared.instants, controller, period)


def recorded(
    prepared: Setup,
    runs: Sequence[int],
    keep_cov: bool = False,
    keep_innovations: bool = False,
    stop: Stop = lambda: False,
) -> tuple[Trajectory, Traces | None] | None:
    """The truth of some runs that is the same for all estimators, and the reference's traces.

    The controller sees the estimate of the scenario's reference estimator, if it has one, else the
    true state. A run whose reference fails has no truth from the next instant on: no estimator can
    be judged there, since its controls would tell the true state at the start.

    Returns:
        The trajectory, and the traces of the reference or None without one; None when stopped.
    """
    if prepared.reference is None:
        return record(driven(prepared, runs)), None
    noting = Noting(driven(prepared, runs))
    traces = followed(prepared.reference, LABEL, runs, noting, keep_cov, keep_innovations, stop)
    if traces is None:
        return None
    truth = noting.trajectory()
    lost = (traces.fault != Fault.NONE) & (traces.fault != Fault.TRUTH)
    for run in np.flatnonzero(lost):
        truth.x[traces.fault_step[run] + 1 :, run] = np.nan
    return replace(truth, lost=lost), replace(traces, truth=truth.x)


def trajectory(prepared: Setup, runs: Sequence[int]) -> Trajectory:
    """The truth, controls and readings of some runs, the same for all estimators; `recorded`."""
    found = recorded(prepared, runs)
    assert found is not None  # nobody stopped it
    return found[0]


def followed(
    prepared: Setup,
    label: str,
    runs: Sequence[int],
    source: Source,
    keep_cov: bool = False,
    keep_innovations: bool = False,
    stop: Stop = lambda: False,
) -> Traces | None:
    """The traces of the estimator of a label on a source of some runs; None when stopped.

    Raises:
        EstimatorError: the estimator raised.
    """
    whole = in_windows(prepared, label, runs, source, None, keep_cov, keep_innovations, stop)
    return next(whole, None)


def in_windows(
    prepared: Setup,
    label: str,
    runs: Sequence[int],
    source: Source,
    length: int | None,
    keep_cov: bool = False,
    keep_innovations: bool = False,
    stop: Stop = lambda: False,
) -> Iterator[Traces]:
    """`followed`, one window of so many instants after the other; see `event_loop.followed`."""
    mean, cov = (np.repeat(a[None], len(runs), axis=0) for a in prepared.prior(label))
    keys = streams.run_keys(prepared.scenario.simulation.seed, runs, f"estimator:{label}")
    estimator = prepared.estimator(label)
    try:
        yield from event_loop.followed(
            estimator, prepared.space, (mean, cov), source, prepared.channel_spaces,
            delays=prepared.delays(label), keys=keys, keep_cov=keep_cov,
            keep_innovations=keep_innovations, stop=stop, length=length,
        )  # fmt: skip
    except (EstbenchError, MemoryError):
        raise
    except (Exception, SystemExit) as error:  # a user's estimator may raise anything
        raise EstimatorError(f"{label} raised {user_error_location(error)}") from error


def blamed(traces: Traces, lost: Bool[Mask, " run"] | None) -> Traces:
    """The traces, in which a run whose truth ended says why, whatever the estimator did before.

    Args:
        traces: of one estimator.
        lost: runs that have no truth for want of a reference, `Trajectory.lost`. In any other run
            without a truth the simulation failed.
    """
    ended = ~np.isfinite(traces.truth).all(axis=-1)
    if not ended.any():
        return traces
    lost = np.zeros(len(traces.fault), bool) if lost is None else lost
    failed = ended.any(axis=0) & ~lost
    fault = np.where(failed, Fault.TRUTH, traces.fault)
    fault = np.where(lost & (fault == Fault.TRUTH), Fault.REFERENCE, fault)
    step = np.where(failed, ended.argmax(axis=0), traces.fault_step)
    return replace(
        traces,
        fault=fault.astype(traces.fault.dtype),
        fault_step=step.astype(traces.fault_step.dtype),
    )


def estimated(
    prepared: Setup,
    label: str,
    runs: Sequence[int],
    truth: Trajectory | None,
    keep_cov: bool = False,
    keep_innovations: bool = False,
    stop: Stop = lambda: False,
) -> tuple[Traces, Trajectory] | None:
    """The traces of an estimator on some runs and the truth that it followed; None when stopped.

    Args:
        prepared: the experiment.
        label: of the estimator.
        runs: their numbers.
        truth: of these runs; None where the controller sees this estimator's own estimate.
        keep_cov: whether to record full covariances.
        keep_innovations: whether to record ν and S.
        stop: asked at every instant; True ends it.
    """
    keep = keep_cov, keep_innovations, stop
    if truth is None:
        noting = Noting(driven(prepared, runs))
        traces = followed(prepared, label, runs, noting, *keep)
        return None if traces is None else (blamed(traces, None), noting.trajectory())
    source = Recorded(prepared.instants, truth)
    traces = followed(prepared, label, runs, source, *keep)
    return None if traces is None else (blamed(traces, truth.lost), truth)
