"""What a replay gives: of each estimator, and of the log."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from estbench.consistency.fields import Record
from estbench.consistency.innovations import InnovationVerdict
from estbench.consistency.statistics import Summary
from estbench.consistency.whiteness import Whiteness
from estbench.experiment.prepared import Setup
from estbench.inference.traces import Traces
from estbench.logs.heldout import Prediction
from estbench.logs.source import Log
from estbench.logs.trajectory import Poses, TrajectoryError, errors


@dataclass(frozen=True, eq=False)
class Replayed:
    """One estimator on a log.

    Attributes:
        label: of the estimator.
        traces: at the times of the log; what needs the truth is NaN where it is not known.
        innovations: the verdict of them.
        summary: the statistics and the verdict: of the errors too where the truth is known.
        record: what a results folder has of the run.
        white: Ljung and Box's test of the innovations; None without two updates.
        predictions: of the channels that are held out.
        poses: free joint -> estimated and true poses where the truth has them.
        failure: why and when it failed; empty if it did not.
        seconds: wall-clock time.
    """

    label: str
    traces: Traces
    innovations: InnovationVerdict
    summary: Summary
    record: Record
    white: Whiteness | None
    predictions: tuple[Prediction, ...]
    poses: Mapping[str, tuple[Poses, Poses]]
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

    @property
    def trajectories(self) -> dict[str, TrajectoryError]:
        """Errors of the poses of each free joint that has three true poses."""
        return {name: errors(*both) for name, both in self.poses.items()}


@dataclass(frozen=True, eq=False)
class Replay:
    """Estimators on one log.

    Attributes:
        prepared: the robot and the estimators, with the instants of the log.
        log: mapped to its channels and controls.
        fused: the channels that the estimators were given.
        replayed: one for each estimator.
        folder: of the stored results, or None.
    """

    prepared: Setup
    log: Log
    fused: tuple[str, ...]
    replayed: tuple[Replayed, ...]
    folder: Path | None = None

    def __getitem__(self, label: str) -> Replayed:
        return {r.label: r for r in self.replayed}[label]
