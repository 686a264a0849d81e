"""The page's tables and sentences, each number in full beside what is shown."""

from collections.abc import Sequence
from typing import Any

from estbench.consistency import Interval
from estbench.report import data, facts, palette
from estbench.report.drawing import Material
from estbench.report.sources import Entry
from estbench.report.traces import TraceStatistics

RELEVANT = 0.01
"""A difference below this part of the baseline's value is not coloured."""
NONE = 1e-4
"""One whose whole interval is below this part is shown as none."""


def _cell(value: float, shown: str, kind: str = "") -> dict[str, Any]:
    """A table cell: the number in full for whoever parses the page, and as it is shown."""
    return {"value": repr(float(value)), "shown": shown, "class": kind}


def entry(material: Material, i: int) -> dict[str, Any]:
    """Row of the table of verdicts."""
    entry = material.entries[i]
    s, nees, nis = entry.summary, material.nees[i], material.nis[i]
    return {
        "key": entry.key,
        "colour": palette.colour(i),
        "dashes": palette.dash(i).replace("px", "").replace("solid", ""),
        "verdict": str(s.verdict),
        "sentence": facts.verdict(entry, nees),
        "cells": [
            _cell(s.anees.value, facts.show(s.anees)),
            _cell(s.anees_median, f"{s.anees_median:.3f}"),
            _cell(s.anis.value, facts.show(s.anis)),
            _cell(s.lag_one.value, facts.show(s.lag_one)),
            _cell(s.diverged, f"{s.diverged:.1%}"),
            _cell(s.cost, f"{s.cost:.3g}"),
            _cell(nees.outside, f"{nees.outside:.1%}"),
            _cell(nis.outside, f"{nis.outside:.1%}"),
        ],
    }


def rmse(entries: Sequence[Entry]) -> list[dict[str, Any]]:
    """Rows of the table of RMSE and σ."""
    source = entries[0].source
    rows = []
    for i, (name, unit) in enumerate(zip(source.names, source.units)):
        cells = []
        for entry in entries:
            s = entry.summary
            cells += [
                _cell(s.rmse[i].value, facts.quantity(s.rmse[i])),
                _cell(s.std[i], f"{s.std[i]:.3g}"),
            ]
        rows.append({"name": name, "unit": unit, "cells": cells})
    return rows


def baselines(entries: Sequence[Entry]) -> list[dict[str, Any]]:
    """A table for each baseline: rows of a quantity, columns of the other entries."""
    out = []
    names, units = entries[0].source.names, entries[0].source.units
    for baseline in entries:
        b = baseline.summary
        pairs = [data.paired(entry, baseline) for entry in entries if entry is not baseline]
        rows = [
            ("cost", "ratio", [_cell(p.ratio, f"{p.ratio:.3g}") for p in pairs]),
            ("NEES/n", "", [_difference(p.anees, b.anees.value) for p in pairs]),
        ]
        for i, (name, unit) in enumerate(zip(names, units)):
            cells = [_difference(p.rmse[i], b.rmse[i].value) for p in pairs]
            rows.append((name, unit, cells))
        out.append({"key": baseline.key, "pairs": pairs, "rows": rows})
    return out


def _difference(difference: Interval, scale: float) -> dict[str, Any]:
    """A cell; coloured where the difference is neither chance nor too small to matter."""
    kind = _kind(difference, scale)
    mark = {"less": " ▼", "more": " ▲"}.get(kind, "")
    none = max(abs(difference.low), abs(difference.high)) < NONE * abs(scale)
    return _cell(difference.value, "≈ 0" if none else facts.quantity(difference) + mark, kind)


def _kind(difference: Interval, scale: float) -> str:
    if not abs(difference.value) > RELEVANT * abs(scale):
        return ""
    return "less" if difference.high < 0 else "more" if difference.low > 0 else ""


def outside(entries: Sequence[Entry], statistics: Sequence[TraceStatistics | None]) -> str:
    """How many single values lie outside the band of one run, in a sentence."""
    level = entries[0].source.level
    parts = [
        f"{e.key} NEES {t.outside[0]:.1%}, NIS {t.outside[1]:.1%}"
        for e, t in zip(entries, statistics)
        if t is not None
    ]
    return (
        f"Single values outside the {level:.0%} band of one run ({1 - level:.0%} expected): "
        f"{'; '.join(parts)}."
    )


def notices(entries: Sequence[Entry], statistics: Sequence[TraceStatistics | None]) -> list[str]:
    """What the reader must know before anything else."""
    out = []
    for source in {id(e.source): e.source for e in entries}.values():
        if len(source.runs) < source.total:
            out.append(
                f"{source.title} is unfinished: {len(source.runs)} of {source.total} runs are done."
            )
    bare = [e.source.title for e, t in zip(entries, statistics) if t is None]
    if bare:
        out.append(
            f"{', '.join(dict.fromkeys(bare))} kept no traces: the error of single runs, coverage, "
            "distributions, autocorrelation, videos and the time of divergence need "
            "`estbench run --keep diagonal`."
        )
    return out
