"""The record of a batch whose traces come window after window: its memory does not grow.

Averages and sums add up. What needs all instants at once (the comparison of instants with a small
and with a large covariance, whose medians are those of the run; sums over the runs at each instant)
is computed from a sample of the instants.
"""

from dataclasses import replace

import numpy as np

from estbench.consistency import blocks
from estbench.consistency.fields import PHASES, BatchTraces, Record
from estbench.consistency.nees import lasting
from estbench.consistency.records import COST, SUMMARY, divergence_window
from estbench.consistency.sums import Sum
from estbench.estimators.beliefs import Fault
from estbench.inference.traces import Traces
from estbench.scenario.schema import ConsistencySection
from estbench.shapes import Array, Bool, Float, Int, Ints, Mask

AT_TIMES = ("truth", "mean", "error", "std", "nees", "rank", "along", "bound", "expected")
AT_INSTANTS = ("nis", "dof", "log_likelihood", "gated", "channel_nis")


class Windows:
    """What is known of a batch so far.

    Args:
        times: of the whole run, s; index 0 is the prior.
        section: burn-in and the definition of divergence.
        sample: the times, by their index, of the sample; the first and the last are in it.
    """

    def __init__(
        self,
        times: Float[Array, " time"],
        section: ConsistencySection,
        sample: Int[Ints, " kept"],
    ):
        self._times, self._section, self._sample = times, section, sample
        self._settled = (times > section.burn_in) & (times > 0)
        self._blocks = blocks.blocks(times, section.burn_in)
        self._duration = divergence_window(times, section)
        self._sums: dict[str, Sum] | None = None
        self._parts: dict[str, list[Array]] = {name: [] for name in AT_TIMES + AT_INSTANTS}
        self._above = np.zeros((0, 0), bool)
        self._lost = self._since = np.zeros(0, bool)
        self._last: Traces | None = None
        self._next = 0  # the time of the first row of the next window

    def add(self, traces: Traces, phases: Bool[Mask, "time run phase"] | None = None) -> None:
        """Add a window. It begins with the last time of the one before, which does not count.

        Args:
            traces: of the window.
            phases: phase of contact of each of its instants, where it is known.
        """
        first, stop = self._next, self._next + len(traces.nees)
        if stop == first + 1:  # late readings may still change all
            return
        if not first:
            runs = traces.nees.shape[1]
            self._above, self._lost = np.zeros((0, runs), bool), np.zeros(runs, bool)
            self._since = np.zeros(runs, bool)
        times, settled = self._times[first:stop].copy(), self._settled[first:stop].copy()
        times[0], settled[0] = 0.0, False
        batch = BatchTraces(
            traces, times, settled, np.zeros_like(self._lost), self._blocks, phases, self._since
        )
        if settled.any():
            self._add_up(batch)
        if phases is not None:
            self._since = self._since | phases[..., PHASES.index("event")].any(axis=0)
        new = 0 if not first else 1
        above = batch.normalized[new:] > self._section.divergence_threshold
        above = np.concatenate([self._above, above])
        self._lost |= lasting(above, self._duration)
        self._above = above[max(len(above) - self._duration + 1, 0) :]
        rows = self._sample[(self._sample >= first + new) & (self._sample < stop)] - first
        for names, where in ((AT_TIMES, rows), (AT_INSTANTS, rows[rows > 0] - 1)):
            for name in names:
                if (values := getattr(traces, name)) is not None:
                    self._parts[name].append(values[where])
        # Only what is not of an instant is read of the last window.
        self._last = traces
        self._next = stop - 1

    def _add_up(self, batch: BatchTraces) -> None:
        """Add the sums of a window; which variables are sums shows in the first."""
        if self._sums is None:
            found = {name: variable.of(batch) for name, variable in SUMMARY.items()}
            self._sums = {k: v for k, v in found.items() if not isinstance(v, np.ndarray)}
            return
        for name, before in self._sums.items():
            self._sums[name] = before + SUMMARY[name].of(batch)  # type: ignore[operator]

    @property
    def finished(self) -> bool:
        """Whether the last window has been added."""
        return self._next == len(self._times) - 1

    def record(self, ended: Int[Ints, " run"], lost: Bool[Mask, " run"]) -> Record:
        """The record of the batch.

        Args:
            ended: index of the first time at which a run has no truth, -1 for none.
            lost: of these the runs that have none for want of a reference.
        """
        assert self._last is not None
        assert self._sums is not None
        failed = (ended >= 0) & ~lost  # as `recording.blamed` has it
        fault = np.where(failed, Fault.TRUTH, self._last.fault)
        fault = np.where(lost & (fault == Fault.TRUTH), Fault.REFERENCE, fault)
        fault = fault.astype(self._last.fault.dtype)
        whole = replace(
            self._last,
            fault=fault,
            fault_step=np.searchsorted(
                self._sample, np.where(failed, ended, self._last.fault_step)
            ) - (~failed & (self._last.fault_step < 0)),
            **{name: np.concatenate(parts) for name, parts in self._parts.items() if parts},
        )  # fmt: skip
        batch = BatchTraces(
            whole, self._times[self._sample], self._settled[self._sample],
            (fault > 0) | self._lost, self._blocks,
        )  # fmt: skip
        sampled = {
            name: variable.values(batch)
            for name, variable in (SUMMARY | COST).items()
            if name not in self._sums
        }
        return sampled | {name: found.value for name, found in self._sums.items()}
