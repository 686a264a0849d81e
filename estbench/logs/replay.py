"""Estimators on a recorded log: what their innovations say of them, and the truth if it has one."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estbench.consistency import innovations, parts, records
from estbench.consistency.innovations import InnovationSeries, by_part, judge_innovations
from estbench.consistency.whiteness import whiteness
from estbench.errors import EstimatorError, StoreError
from estbench.estimators.beliefs import Fault
from estbench.experiment.prepared import Setup
from estbench.experiment.recording import followed
from estbench.inference.innovations import readings
from estbench.inference.traces import Traces
from estbench.logs import store, truth
from estbench.logs.heldout import predicted
from estbench.logs.judged import judged
from estbench.logs.outcome import Replay, Replayed
from estbench.logs.prepare import prepare
from estbench.logs.source import Log, LogSource
from estbench.logs.trajectory import Poses
from estbench.scenario.load import Chosen, Scenario, resolve
from estbench.shapes import Bool, Mask


def replay(
    scenario: str | Path | Scenario,
    logs: str | Path | Sequence[str | Path],
    estimators: Chosen | None = None,
    *,
    hold_out: Sequence[str] = (),
    overrides: Sequence[str] = (),
    out: str | Path | None = None,
) -> Replay:
    """Run estimators on a recorded log.

    The log starts at the prior of the scenario. Each reading is fused at the time it was taken; a
    prediction may be over any interval, which is divided into equal physics steps.

    Args:
        scenario: as of `estbench.run`, with a section `[log]`.
        logs: the files of one log.
        estimators: labels, names or classes, in place of the scenario's.
        hold_out: channels that are predicted and not fused.
        overrides: `section.key=value` strings.
        out: folder of the results, which `compare`, `report`, `plot`, `video` and `explain` read;
            None writes nothing.

    Raises:
        EstbenchError: the log does not fit the scenario, or an estimator cannot run on it.
    """
    if out is not None and Path(out).exists():
        raise StoreError(f"{out} exists; choose another --out, or remove it")
    resolved = resolve(scenario, estimators, overrides=overrides)
    files = [logs] if isinstance(logs, str | Path) else list(logs)
    found = replay_on(*prepare(resolved, files, hold_out), hold_out)
    return found if out is None else store.write(found, Path(out))


def replay_on(prepared: Setup, log: Log, hold_out: Sequence[str] = ()) -> Replay:
    """Run the estimators of an experiment on a log that is mapped to it.

    Args:
        prepared: with the instants of the log.
        log: mapped.
        hold_out: channels that are predicted and not fused.
    """
    fused = fused_of(prepared, hold_out)
    times, section = prepared.times, prepared.scenario.consistency
    settled = (times > section.burn_in) & (times > 0)
    followers = [_follow(prepared, log, fused, label) for label in prepared.scenario.estimators]
    # The same parts for all: estimators are compared part by part.
    most = min((parts.most_parts(f.traces, settled) for f in followers), default=1)
    return Replay(
        prepared, log, fused, tuple(_judged(prepared, log, fused, f, most) for f in followers)
    )


def fused_of(prepared: Setup, hold_out: Sequence[str]) -> tuple[str, ...]:
    """The channels that the estimators are given."""
    return tuple(name for name in prepared.channel_spaces if name not in hold_out)


@dataclass(frozen=True, eq=False)
class _Followed:
    """An estimator on a log, before it is judged."""

    label: str
    traces: Traces
    poses: dict[str, tuple[Poses, Poses]]
    seconds: float


def _follow(prepared: Setup, log: Log, fused: Sequence[str], label: str) -> _Followed:
    began = time.perf_counter()
    traces = followed(prepared, label, [0], LogSource(log, fused), True, True)
    seconds = time.perf_counter() - began
    if traces is None or traces.innovation is None or traces.innovation_cov is None:
        raise EstimatorError(f"{label} gave no innovations on the log")
    return _Followed(label, *_with_truth(prepared, log, traces), seconds)


def _judged(prepared: Setup, log: Log, fused: Sequence[str], one: _Followed, most: int) -> Replayed:
    label, traces = one.label, one.traces
    section, times = prepared.scenario.consistency, prepared.times
    channels, components = tuple(prepared.channel_spaces), readings(prepared.channel_spaces)
    settled = (times > section.burn_in) & (times > 0)
    series = series_of(traces, settled)
    record = records.reduce(traces, times, section, "log")
    diverged = bool(record["diverged"][0])
    sample = parts.of_log(traces, times, settled, diverged, series, most)
    white = by_part(series, innovations.parts(np.arange(len(series.nis))))
    fault, step = int(traces.fault[0]), int(traces.fault_step[0])
    return Replayed(
        label,
        traces,
        judge_innovations(
            series, channels, components, fault > 0, section.level, section.tolerance
        ),
        parts.summarize_log(
            label, sample, white, times, section, prepared.space.names, channels, components,
            log.truth is not None,
        ),
        record | parts.stored(sample, white),
        whiteness(traces.lags, traces.lag_terms, section.level),
        tuple(
            predicted(prepared, label, log, name, traces) for name in channels if name not in fused
        ),
        one.poses,
        f"t = {times[max(step, 0)]:.6g} s: {Fault(fault).text}" if fault else "",
        one.seconds,
    )  # fmt: skip


def _with_truth(
    prepared: Setup, log: Log, traces: Traces
) -> tuple[Traces, dict[str, tuple[Poses, Poses]]]:
    """The traces with their errors, and the poses of free joints."""
    given = prepared.scenario.log and prepared.scenario.log.truth
    if log.truth is None or given is None:
        return traces, {}
    space, estimate = prepared.space, traces.mean[:, 0]
    rigid = truth.transform(given, log.truth, space, estimate)
    found = truth.moved(log.truth, space, rigid)
    poses = {}
    for name, (position, turn, _) in truth.bodies(space).items():
        there = np.isfinite(found.x[:, position.start : turn.stop]).all(axis=1)
        there &= np.isfinite(estimate).all(axis=1)
        if there.sum() >= 3:
            poses[name] = tuple(
                Poses(prepared.times[there], x[there, position], x[there, turn])
                for x in (estimate, found.x)
            )
    return judged(traces, space, found), poses


def series_of(traces: Traces, settled: Bool[Mask, " time"]) -> InnovationSeries:
    """The innovations of the updates that count.

    Args:
        traces: of one run, with its innovations.
        settled: instants that count.
    """
    assert traces.innovation is not None
    assert traces.innovation_cov is not None
    counted = settled[1:] & (traces.dof[:, 0] > 0)
    std = np.sqrt(np.diagonal(traces.innovation_cov[1:, 0], axis1=-2, axis2=-1))
    return InnovationSeries(
        traces.nis[counted, 0],
        traces.dof[counted, 0],
        traces.channel_nis[counted, 0],
        (traces.innovation[1:, 0] / std)[counted],
    )
