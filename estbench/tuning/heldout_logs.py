"""The filter before and after the tuning on logs, those of the tuning and others."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from estbench.consistency.intervals import Interval, mean_interval
from estbench.errors import StudyError
from estbench.logs.heldout import Prediction
from estbench.logs.replay import Replayed
from estbench.scenario.schema import Scenario
from estbench.tables.cells import plain
from estbench.tables.columns import Column, Table
from estbench.tables.quantity import number, quantity
from estbench.tuning.evaluation import Values
from estbench.tuning.logged import LogFiles, Logged, OneLog, in_blocks


@dataclass(frozen=True, eq=False)
class LogPair:
    """Before and after on one log.

    Attributes:
        name: of the log.
        held_out: whether the tuning has not seen it.
        before, after: the filter on it.
        likelihood: before and after, mean log-likelihood of an update.
        change: paired difference after - before, across blocks of time.
        units: channel -> units of its readings.
    """

    name: str
    held_out: bool
    before: Replayed
    after: Replayed
    likelihood: tuple[Interval, Interval]
    change: Interval
    units: dict[str, tuple[str, ...]]


@dataclass(frozen=True, eq=False)
class HeldOutLogs:
    """Before and after on every log; see `result.Proof`.

    Attributes:
        pairs: the logs of the tuning, then those held out.
    """

    pairs: tuple[LogPair, ...]

    def head(self, level: float) -> str:
        """What the tables compare."""
        return (
            "each log before and after; log-likelihood: mean per update, its change paired, "
            f"brackets and ±: {level:.0%} interval across blocks of time; the verdict is of the "
            "innovations alone"
        )

    def tables(self) -> list[Table]:
        """Innovations of the fused channels, then predictions of those held out."""
        rows = [
            (p, side, r, i)
            for p in self.pairs
            for side, r, i in zip(("before", "after"), (p.before, p.after), p.likelihood)
        ]
        keys = (
            Column("log", tuple(p.name for p, *_ in rows), "left"),
            Column("", tuple("held out" if p.held_out else "tuned" for p, *_ in rows), "left"),
            Column("filter", tuple(side for _, side, *_ in rows), "left"),
        )
        columns = (
            Column("verdict", tuple(str(r.innovations.verdict) for _, _, r, _ in rows), "left"),
            Column("NIS/m", tuple(quantity(r.innovations.nis) for _, _, r, _ in rows)),
            Column("log-likelihood", tuple(quantity(i) for *_, i in rows)),
            Column("change", tuple(
                quantity(p.change) if side == "after" else "" for p, side, *_ in rows)),
            Column("lag one", tuple(number(r.innovations.lag_one) for _, _, r, _ in rows)),
            Column("whiteness p", tuple(
                "–" if r.white is None else number(r.white.p) for _, _, r, _ in rows)),
        )  # fmt: skip
        first = Table(keys, tuple((c,) for c in columns), "fused channels")
        return [first, *self._predictions()]

    def words(self) -> list[str]:
        """Held-out logs on which the tuned filter is worse."""
        return [
            f"over-fitted: the log-likelihood of {p.name}, which was held out, changes by "
            f"{quantity(p.change)} per update; tune on more logs, or free less"
            for p in self.pairs
            if p.held_out and p.change.high < 0
        ]

    def lines(self) -> list[str]:
        """One for each log."""
        return [
            f"{p.name}, {'held out' if p.held_out else 'tuned on'}: {p.before.innovations.verdict} "
            f"-> {p.after.innovations.verdict}, NIS/m {quantity(p.before.innovations.nis)} -> "
            f"{quantity(p.after.innovations.nis)}, log-likelihood per update "
            f"{quantity(p.likelihood[0])} -> {quantity(p.likelihood[1])}."
            for p in self.pairs
        ]

    def to_dict(self) -> dict[str, Any]:
        """Of each log."""
        return {
            p.name: {
                "held_out": p.held_out,
                "log_likelihood_difference": plain(p.change),
                **{side: _plain(r, i) for side, r, i in zip(
                    ("before", "after"), (p.before, p.after), p.likelihood)},
            }
            for p in self.pairs
        }  # fmt: skip

    def _predictions(self) -> list[Table]:
        """Of the channels that are not fused; none without one."""
        rows = [
            (p, a.channel, i, b, a)
            for p in self.pairs
            for b, a in zip(p.before.predictions, p.after.predictions)
            for i in range(a.error.shape[1])
        ]
        if not rows:
            return []
        keys = (
            Column("log", tuple(p.name for p, *_ in rows), "left"),
            Column("", tuple("held out" if p.held_out else "tuned" for p, *_ in rows), "left"),
            Column("channel", tuple(
                name if b.error.shape[1] == 1 else f"{name}[{i}]" for _, name, i, b, _ in rows
            ), "left"),
            Column("unit", tuple(p.units[name][i] for p, name, i, *_ in rows), "left"),
        )  # fmt: skip

        def pair(heading: str, value: Any) -> tuple[Column, ...]:
            return (
                Column(f"{heading} before", tuple(number(value(b, i)) for *_, i, b, _ in rows)),
                Column("after", tuple(number(value(a, i)) for *_, i, _, a in rows)),
            )

        return [Table(keys, (
            pair("RMS error", lambda p, i: _rms(p, i)),
            pair("median", lambda p, i: float(np.median(np.abs(p.error[:, i])))),
            pair("(error/σ)²", lambda p, i: float(np.mean((p.error[:, i] / p.std[:, i]) ** 2))),
        ), "channels that are predicted and not fused")]  # fmt: skip


def compare(tuning: Logged, held_out: Logged | None, values: Values, level: float) -> HeldOutLogs:
    """The estimator before and after on the logs of the tuning and on others.

    Args:
        tuning: what the values were tuned on.
        held_out: the other logs; None for none.
        values: of the free parameters, after.
        level: of the intervals.
    """
    pairs = [_pair(tuning, log, values, level, False) for log in tuning.logs]
    if held_out is not None:
        held_out.free = tuning.free
        pairs += [_pair(held_out, log, values, level, True) for log in held_out.logs]
    return HeldOutLogs(tuple(pairs))


def _pair(source: Logged, log: OneLog, values: Values, level: float, held_out: bool) -> LogPair:
    was, now = source.replayed(log), source.replayed(log, values)
    (before,), (after,) = was.replayed, now.replayed
    means = [
        np.array([part.mean() for part in in_blocks(r.traces, log.blocks)]) for r in (before, after)
    ]
    units = {name: tuple(s.units) for name, s in was.prepared.channel_spaces.items()}
    return LogPair(
        log.name, held_out, before, after,
        (mean_interval(means[0], level), mean_interval(means[1], level)),
        mean_interval(means[1] - means[0], level), units,
    )  # fmt: skip


def _rms(p: Prediction, i: int) -> float:
    return float(np.sqrt(np.mean(p.error[:, i] ** 2)))


def _plain(r: Replayed, likelihood: Interval) -> dict[str, Any]:
    judged = r.innovations
    return {
        "verdict": str(judged.verdict), "nis_over_m": plain(judged.nis),
        "log_likelihood_per_update": plain(likelihood), "lag_one": plain(judged.lag_one),
        "whiteness_p": None if r.white is None else plain(r.white.p),
        "predicted": {
            p.channel: {
                "rms_error": [plain(_rms(p, i)) for i in range(p.error.shape[1])],
                "scaled_square": plain(float(p.ratio.mean())),
            }
            for p in r.predictions
        },
    }  # fmt: skip


def given(
    scenario: Scenario,
    label: str,
    recorded: Logged | None,
    logs: Sequence[LogFiles],
    hold_out: Sequence[str],
) -> Logged | None:
    """The logs that are held out.

    Raises:
        StudyError: there are none to tune on, or one is among those.
    """
    if not logs:
        return None
    if recorded is None:
        raise StudyError("--held-out-log needs a log to tune on; name one with --log")
    found = Logged(scenario, label, logs, hold_out)
    twice = _shared(recorded.logs, found.logs)
    if twice is not None:
        raise StudyError(f"{twice} is tuned on and held out; use it once")
    return found


def _shared(logs: Sequence[OneLog], others: Sequence[OneLog]) -> str | None:
    """The name of a log that is in both; None for none."""
    known = {tuple(t.path.resolve() for t in log.tables) for log in logs}
    both = [o.name for o in others if tuple(t.path.resolve() for t in o.tables) in known]
    return both[0] if both else None
