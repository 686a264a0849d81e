"""Estimators on a recorded log, without truth: what their innovations say of them."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estbench.consistency.innovations import (
    InnovationSeries,
    InnovationVerdict,
    judge_innovations,
)
from estbench.consistency.whiteness import Whiteness, whiteness
from estbench.errors import EstimatorError
from estbench.estimators.beliefs import Fault
from estbench.experiment.prepared import Setup
from estbench.experiment.recording import followed
from estbench.inference.innovations import readings
from estbench.inference.traces import Traces
from estbench.logs.heldout import Prediction, predicted
from estbench.logs.prepare import prepare
from estbench.logs.source import Log, LogSource
from estbench.scenario.load import Chosen, Scenario, resolve


@dataclass(frozen=True, eq=False)
class Replayed:
    """One estimator on a log.

    Attributes:
        label: of the estimator.
        traces: at the times of the log; what needs the truth is NaN.
        innovations: the verdict of them.
        white: Ljung and Box's test of them; None without two updates.
        predictions: of the channels that are held out.
        failure: why and when it failed; empty if it did not.
        seconds: wall-clock time.
    """

    label: str
    traces: Traces
    innovations: InnovationVerdict
    white: Whiteness | None
    predictions: tuple[Prediction, ...]
    failure: str
    seconds: float

    @property
    def updates(self) -> int:
        """Instants at which something was fused."""
        return int((self.traces.dof > 0).sum())

    @property
    def log_likelihood(self) -> float:
        """Log p(y) of all that was fused."""
        return float(self.traces.log_likelihood.sum())


@dataclass(frozen=True, eq=False)
class Replay:
    """Estimators on one log.

    Attributes:
        prepared: the robot and the estimators, with the instants of the log.
        log: mapped to its channels and controls.
        fused: the channels that the estimators were given.
        replayed: one for each estimator.
    """

    prepared: Setup
    log: Log
    fused: tuple[str, ...]
    replayed: tuple[Replayed, ...]

    def __getitem__(self, label: str) -> Replayed:
        return {r.label: r for r in self.replayed}[label]


def replay(
    scenario: str | Path | Scenario,
    logs: str | Path | Sequence[str | Path],
    estimators: Chosen | None = None,
    *,
    hold_out: Sequence[str] = (),
    overrides: Sequence[str] = (),
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

    Raises:
        EstbenchError: the log does not fit the scenario, or an estimator cannot run on it.
    """
    resolved = resolve(scenario, estimators, overrides=overrides)
    files = [logs] if isinstance(logs, str | Path) else list(logs)
    return replay_on(*prepare(resolved, files, hold_out), hold_out)


def replay_on(prepared: Setup, log: Log, hold_out: Sequence[str] = ()) -> Replay:
    """Run the estimators of an experiment on a log that is mapped to it.

    Args:
        prepared: with the instants of the log.
        log: mapped.
        hold_out: channels that are predicted and not fused.
    """
    fused = fused_of(prepared, hold_out)
    labels = prepared.scenario.estimators
    return Replay(
        prepared, log, fused, tuple(_replayed(prepared, log, fused, label) for label in labels)
    )


def fused_of(prepared: Setup, hold_out: Sequence[str]) -> tuple[str, ...]:
    """The channels that the estimators are given."""
    return tuple(name for name in prepared.channel_spaces if name not in hold_out)


def _replayed(prepared: Setup, log: Log, fused: Sequence[str], label: str) -> Replayed:
    began = time.perf_counter()
    traces = followed(prepared, label, [0], LogSource(log, fused), True, True)
    seconds = time.perf_counter() - began
    if traces is None or traces.innovation is None or traces.innovation_cov is None:
        raise EstimatorError(f"{label} gave no innovations on the log")
    times = np.array([i.end for i in log.instants])
    section = prepared.scenario.consistency
    counted = (traces.dof[:, 0] > 0) & (times > section.burn_in)
    std = np.sqrt(np.diagonal(traces.innovation_cov[1:, 0], axis1=-2, axis2=-1))
    place = [list(prepared.channel_spaces).index(name) for name in fused]
    names = readings(prepared.channel_spaces)
    own = readings({name: prepared.channel_spaces[name] for name in fused})
    columns = [names.index(name) for name in own]
    series = InnovationSeries(
        traces.nis[counted, 0],
        traces.dof[counted, 0],
        traces.channel_nis[counted, 0][:, place],
        (traces.innovation[1:, 0] / std)[counted][:, columns],
    )
    fault, step = int(traces.fault[0]), int(traces.fault_step[0])
    held = [name for name in prepared.channel_spaces if name not in fused]
    return Replayed(
        label,
        traces,
        judge_innovations(series, fused, own, fault > 0, section.level, section.tolerance),
        whiteness(traces.lags, traces.lag_terms, section.level),
        tuple(predicted(prepared, label, log, name, traces) for name in held),
        f"t = {times[max(step - 1, 0)]:.6g} s: {Fault(fault).text}" if fault else "",
        seconds,
    )
