"""Candidates on recorded logs: the log-likelihood of their readings, block of time by block.

A log is one run whose steps are correlated. Blocks of time that are long against the correlation
are nearly independent (batch means, as in `consistency.innovations`) and take the place of runs.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estbench.consistency.innovations import parts
from estbench.errors import EstbenchError, StudyError
from estbench.experiment.prepared import Setup
from estbench.experiment.recording import followed
from estbench.experiment.setup import variant
from estbench.inference.traces import Traces
from estbench.logs import files, prepare
from estbench.logs.replay import Replay, fused_of, replay_on
from estbench.logs.source import LogSource
from estbench.logs.table import LogTable
from estbench.scenario.schema import Scenario
from estbench.shapes import Array, Float
from estbench.study import keys
from estbench.tuning.evaluation import Evaluation, Values, stacked
from estbench.tuning.objective import KINDS

LogFiles = str | Path | Sequence[str | Path]
"""The files of one log."""


@dataclass(frozen=True, eq=False)
class OneLog:
    """The files of a log, and what the scenario makes of them.

    Attributes:
        name: of its files.
        tables: their columns.
        start: the experiment before the tuning, with the instants of the log.
        blocks: into which its updates are divided.
    """

    name: str
    tables: list[LogTable]
    start: Setup
    blocks: int


class Logged:
    """Candidates of one estimator on recorded logs.

    Args:
        scenario: with a section `[log]`.
        label: of the estimator.
        logs: the files of each log.
        hold_out: channels that are not fused.

    Attributes:
        logs: as they are mapped.
        names: none: no error is known.
        runs: blocks of time of all logs.
    """

    names: tuple[str, ...] = ()

    def __init__(
        self,
        scenario: Scenario,
        label: str,
        logs: Sequence[LogFiles],
        hold_out: Sequence[str] = (),
    ):
        only = scenario.model_copy(update={"estimators": {label: scenario.estimators[label]}})
        self._built = prepare.built(only, hold_out)
        self._label, self._hold_out = label, tuple(hold_out)
        self._fused = fused_of(self._built, hold_out)
        self.free: tuple[keys.Names, ...] = ()
        self.logs = tuple(self._read(log) for log in logs)
        self.runs = sum(log.blocks for log in self.logs)

    @property
    def start(self) -> Setup:
        """The experiment before the tuning, with the instants of the first log."""
        return self.logs[0].start

    def __call__(self, candidates: Sequence[Values]) -> Evaluation:
        """The log-likelihood of each block; a candidate that is refused or raises has a reason."""
        return stacked([self._one(values) for values in candidates])

    def replayed(self, log: OneLog, values: Values | None = None) -> Replay:
        """The estimator of a candidate on a log; without values that before the tuning."""
        built = self._built if values is None else self._variant(values)
        return replay_on(*prepare.laid_on(built, log.tables), self._hold_out)

    def _read(self, log: LogFiles) -> OneLog:
        paths = [log] if isinstance(log, str | Path) else list(log)
        tables = files.read_all(paths)
        start, mapped = prepare.laid_on(self._built, tables)
        arrived = {t for c in mapped.channels if c.name in self._fused for t in c.taken.tolist()}
        name = " + ".join(Path(path).name for path in paths)
        return OneLog(name, tables, start, len(parts(np.arange(len(arrived)))))

    def _variant(self, values: Values) -> Setup:
        return variant(
            self._built, keys.changed(self._built.scenario, dict(zip(self.free, values)))
        )

    def _one(self, values: Values) -> Evaluation:
        reason = ""
        try:
            built = self._variant(values)
            total = np.concatenate([self._on(built, log) for log in self.logs])
        except EstbenchError as error:
            reason, total = str(error), np.full(self.runs, np.nan)
        return Evaluation(total[None], None, None, None, (reason,))

    def _on(self, built: Setup, log: OneLog) -> Float[Array, " block"]:
        """The log-likelihood of each block of a log; NaN if the estimator fails in it."""
        prepared, mapped = prepare.laid_on(built, log.tables)
        traces = followed(prepared, self._label, [0], LogSource(mapped, self._fused))
        assert traces is not None  # nobody stopped it
        if traces.fault[0]:
            return np.full(log.blocks, np.nan)
        return np.array([part.sum() for part in in_blocks(traces, log.blocks)])


def in_blocks(traces: Traces, blocks: int) -> list[Float[Array, " update"]]:
    """Log p(y | earlier readings) of the updates in each block of time."""
    return np.array_split(traces.log_likelihood[traces.dof[:, 0] > 0, 0], blocks)


def given(
    scenario: Scenario,
    label: str,
    logs: Sequence[LogFiles],
    hold_out: Sequence[str],
    simulated: tuple[object, ...],
    objective: str,
) -> Logged | None:
    """The logs of the tuning; None where runs are simulated.

    Raises:
        StudyError: what is said of runs does not fit logs, or the other way round.
    """
    if not logs:
        if hold_out:
            raise StudyError(f"--hold-out {hold_out[0]} is for logs; name one with --log")
        return None
    for name, value in zip(("--runs", "--duration", "--held-out"), simulated):
        if value is not None:
            raise StudyError(f"{name} is {value}, which simulated runs have and a log has not; "
                             "leave it out, or use log.duration and --held-out-log")  # fmt: skip
    if objective in KINDS and objective != "likelihood":
        raise StudyError(
            f"objective {objective!r} needs the true state, which a recorded log lacks; use "
            "likelihood"
        )
    return Logged(scenario, label, logs, hold_out)
