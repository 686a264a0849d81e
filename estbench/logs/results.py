"""The tables of a replay, and its numbers for JSON."""

import json
from typing import Any

import numpy as np
from rich.console import Group
from rich.text import Text

from estbench.consistency.intervals import Interval
from estbench.logs.heldout import Prediction
from estbench.logs.outcome import Replay, Replayed
from estbench.logs.source import Log
from estbench.tables.columns import Table, tabulate
from estbench.tables.names import visible


def rates(log: Log) -> Table:
    """The readings of each channel as they were: how many, how fast, with which gaps."""
    rows = []
    for part in log.channels:
        gaps = np.diff(np.sort(part.taken))
        rows.append([
            part.name, str(len(part.y)), str(part.missing), _number(1 / np.median(gaps))
            if len(gaps) and np.median(gaps) > 0 else "-",
            _number(1e3 * gaps.max()) if len(gaps) else "-",
            _number(1e3 * float((part.arrived - part.taken).max())),
        ])  # fmt: skip
    headings = ("<channel", "readings", "missing", "rate Hz", "longest gap ms", "latest ms")
    return tabulate("readings", headings, rows, "rate: of the median interval")


def verdicts(found: Replay) -> Table:
    """One row for each estimator."""
    truth = found.log.truth is not None
    rows = []
    for r in found.replayed:
        seen = int(r.traces.dof.sum())
        nees = [_interval(r.summary.anees)] if truth else []
        rows.append([
            r.label, str(r.summary.verdict), *nees, _interval(r.innovations.nis),
            _number(r.log_likelihood / max(r.updates, 1)), _number(r.innovations.lag_one),
            _number(r.white.p) if r.white else "-",
            f"{r.traces.gated.sum() / max(seen, 1):.2%}", str(int(r.traces.late.sum())),
            _number(found.log.duration / r.seconds),
        ])  # fmt: skip
    headings = (
        "<estimator", "<verdict", *(["NEES/n"] if truth else []), "NIS/m",
        "log-likelihood per update", "lag-one correlation", "whiteness p", "gated", "late",
        "x real time",
    )  # fmt: skip
    level = found.prepared.scenario.consistency.level
    note = (
        f"{'' if truth else 'the verdict is of the innovations alone; '}brackets: the {level:.0%} "
        "interval from means over parts of time; ideal: "
        f"{'NEES/n and ' if truth else ''}NIS/m 1, correlation 0"
    )
    return tabulate("verdict", headings, rows, note)


def by_channel(found: Replay) -> Table:
    """NIS/m of each channel that was fused, and the mean innovation of its components."""
    spaces = found.prepared.channel_spaces
    rows = []
    for r in found.replayed:
        start = 0
        for name, nis in zip(spaces, r.innovations.channels):
            bias = r.innovations.bias[start : start + spaces[name].n]
            start += spaces[name].n
            if name not in found.fused:
                continue
            rows.append([r.label, name, _interval(nis), ", ".join(map(_number, bias))])
    note = "NIS/m of a channel: given the channels before it at the same time"
    headings = ("<estimator", "<channel", "NIS/m", "mean innovation/σ")
    return tabulate("fused channels", headings, rows, note)


def accuracy(found: Replay) -> Table | None:
    """RMSE and mean error of each coordinate whose truth is known; None without truth."""
    if found.log.truth is None:
        return None
    space, rows = found.prepared.space, []
    for r in found.replayed:
        for i, (name, unit) in enumerate(zip(space.names, space.units)):
            rmse = r.summary.rmse[i]
            if not np.isfinite(rmse.value):
                continue
            noise = found.log.truth.noise[i]
            rows.append([
                r.label, name, unit, _interval(rmse), _interval(r.summary.mean_error[i]),
                _number(r.summary.std[i]), _number(noise),
            ])  # fmt: skip
    headings = ("<estimator", "<coordinate", "<unit", "RMSE", "mean error", "mean σ", "σ of truth")
    unknown = [name for i, name in enumerate(space.names) if not found.log.truth.known[:, i].any()]
    note = "mean σ is what the filter reports; NEES counts the noise of the truth"
    if unknown:
        note += f"; no truth of {', '.join(unknown)}"
    return tabulate("errors", headings, rows, note)


def moving(found: Replay) -> Table | None:
    """ATE and RPE of the poses of free joints; None without true poses."""
    rows = []
    for r in found.replayed:
        for name, e in r.trajectories.items():
            rows.append([
                r.label, name, str(e.poses), _number(e.ate), _number(np.degrees(e.ate_turn)),
                _number(e.rpe), _number(np.degrees(e.rpe_turn)), str(e.frames),
            ])  # fmt: skip
    if not rows:
        return None
    headings = (
        "<estimator", "<body", "poses", "ATE m", "ATE deg", "RPE m", "RPE deg", "frames",
    )  # fmt: skip
    note = (
        "root mean squares; ATE: after the estimate is fitted to the truth (Umeyama, no scale); "
        "RPE: of all pairs of poses that are so many frames apart, about 1 s"
    )
    return tabulate("poses", headings, rows, note)


def held_out(found: Replay) -> Table | None:
    """How well the channels that were held out are predicted; None without one."""
    spaces = found.prepared.channel_spaces
    rows = []
    for r in found.replayed:
        for p in r.predictions:
            for i, unit in enumerate(spaces[p.channel].units):
                name = p.channel if p.error.shape[1] == 1 else f"{p.channel}[{i}]"
                error = p.error[:, i]
                rows.append([
                    r.label, name, unit, str(len(error)), _number(np.sqrt(np.mean(error**2))),
                    _number(np.median(np.abs(error))), _number(np.mean(p.std[:, i])),
                    _number(np.mean((error / p.std[:, i]) ** 2)),
                    f"{np.mean(np.abs(error) < 2 * p.std[:, i]):.1%}",
                ])  # fmt: skip
    if not rows:
        return None
    headings = (
        "<estimator", "<held out", "<unit", "readings", "RMS error", "median |error|", "mean σ",
        "(error/σ)²", "within 2σ",
    )  # fmt: skip
    note = "error: reading less prediction; σ² = H P Hᵀ + R counts the noise of the reading"
    return tabulate("predicted channels", headings, rows, note)


def render(found: Replay) -> Group:
    """The tables for a rich console."""
    scenario, log = found.prepared.scenario, found.log
    source = ", ".join(dict.fromkeys(part.table.path.name for part in log.channels))
    parts: list[Any] = [
        Text(visible(f"{scenario.name} on {source}: {log.duration:.6g} s, {len(log.instants)} "
             f"instants{'' if log.truth else ', no truth'}"), style="bold"),
    ]  # fmt: skip
    parts += [Text(visible(f"note: {line}"), style="yellow") for line in log.notices]
    tables = (
        rates(log), verdicts(found), accuracy(found), moving(found), by_channel(found),
        held_out(found),
    )  # fmt: skip
    for table in tables:
        if table is not None:
            parts += [Text(table.title, style="bold"), table, Text(table.note, style="dim")]
    for r in found.replayed:
        if r.summary.reason:
            parts.append(Text(visible(f"{r.label}: {r.summary.reason}")))
        if r.failure:
            parts.append(Text(visible(f"{r.label} failed at {r.failure}"), style="red"))
    if found.folder is not None:
        parts.append(Text(f"written to {found.folder}"))
    return Group(*parts)


def to_dict(found: Replay) -> dict[str, Any]:
    """Plain numbers for JSON; a value that is not finite becomes None."""
    log = found.log
    return {
        "scenario": found.prepared.scenario.name,
        "duration_s": log.duration,
        "instants": len(log.instants),
        "notices": list(log.notices),
        "channels": {
            part.name: {
                "readings": len(part.y),
                "missing": part.missing,
                "file": str(part.table.path),
            }
            for part in log.channels
        },
        "folder": None if found.folder is None else str(found.folder),
        "truth": log.truth is not None,
        "estimators": {r.label: _plain(r, found) for r in found.replayed},
    }


def to_json(found: Replay) -> str:
    """`to_dict` as JSON text."""
    return json.dumps(to_dict(found), indent=2, allow_nan=False)


def _plain(r: Replayed, found: Replay) -> dict[str, Any]:
    judged, space = r.innovations, found.prepared.space
    spaces = found.prepared.channel_spaces
    return {
        "verdict": str(r.summary.verdict),
        "reason": r.summary.reason,
        "failure": r.failure,
        "updates": r.updates,
        "nis": _bounds(judged.nis),
        "nis_by_channel": {
            n: _bounds(i) for n, i in zip(spaces, judged.channels) if n in found.fused
        },
        "nees": _bounds(r.summary.anees),
        "rmse": {
            name: {"unit": unit, **_bounds(rmse)}
            for name, unit, rmse in zip(space.names, space.units, r.summary.rmse)
            if np.isfinite(rmse.value)
        },
        "poses": {n: _finite_all(vars(e)) for n, e in r.trajectories.items()},
        "log_likelihood": _finite(r.log_likelihood),
        "lag_one": _finite(judged.lag_one),
        "whiteness_p": _finite(r.white.p) if r.white else None,
        "gated": int(r.traces.gated.sum()),
        "late": int(r.traces.late.sum()),
        "seconds": r.seconds,
        "predicted": {p.channel: _predicted(p) for p in r.predictions},
    }


def _predicted(p: Prediction) -> dict[str, Any]:
    return {
        "readings": len(p.times),
        "rms_error": [_finite(x) for x in np.sqrt(np.mean(p.error**2, axis=0))],
        "median_error": [_finite(x) for x in np.median(np.abs(p.error), axis=0)],
        "mean_std": [_finite(x) for x in p.std.mean(axis=0)],
        "scaled_square": _finite(p.ratio.mean()),
    }


def _bounds(interval: Interval) -> dict[str, float | None]:
    return _finite_all(vars(interval))


def _finite_all(values: dict[str, Any]) -> dict[str, float | None]:
    return {k: _finite(v) for k, v in values.items()}


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _number(value: float | np.floating[Any]) -> str:
    return f"{value:.3g}"


def _interval(interval: Interval) -> str:
    return f"{interval.value:.3g} [{interval.low:.3g}, {interval.high:.3g}]"
