"""The page's tables and notices; each cell has the number in full and as it is shown."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from estbench.analysis.comparison import Pair, Paired
from estbench.consistency import statistics
from estbench.consistency.declaration import Statistic
from estbench.consistency.phases import by_phase as phase_statistics
from estbench.consistency.statistics import COST, LAG_ONE, Summary
from estbench.report import facts
from estbench.report.figures import palette
from estbench.report.figures.drawing import Material
from estbench.report.figures.innovations import Correlation
from estbench.report.figures.traces import TraceStatistics
from estbench.report.pairs import MARGIN, differences
from estbench.report.sources import Entry
from estbench.store.versions import known, mixed
from estbench.tables import phases
from estbench.tables.cells import estimate, of_summary, share, value_of
from estbench.tables.columns import Table
from estbench.tables.quantity import bounds, number, percent, probability, quantity

MARKS = {"": "", "less": " ▼", "more": " ▲"}
NONE = 1e-4
"""A difference whose whole interval is below this part of the value is shown as 0."""


def _cell(value: float, shown: str, kind: str = "", p: float | None = None) -> dict[str, Any]:
    """A table cell: the number in full, for programs, and as it is shown."""
    cell = {"value": repr(float(value)), "shown": shown, "class": kind}
    return cell if p is None else cell | {"p": repr(float(p)), "p_shown": probability(p)}


def _share(value: float) -> dict[str, Any]:
    return _cell(value, share(value))


def _statistic(s: Statistic, value: Any, summary: Summary) -> dict[str, Any]:
    return _cell(estimate(value), of_summary(summary, s, value, s.places["report"]))


def entry(material: Material, i: int) -> dict[str, Any]:
    """Row of the table of verdicts."""
    entry = material.entries[i]
    summary, nees, nis = entry.summary, material.nees[i], material.nis[i]
    shown = statistics.shown("report", summaries=[e.summary for e in material.entries])
    return {
        "key": entry.key,
        "colour": palette.colour(i),
        "dashes": palette.dash(i).replace("px", "").replace("solid", ""),
        "verdict": str(summary.verdict),
        "sentence": facts.verdict(entry, nees),
        "causes": facts.causes(entry),
        "cells": [
            *(_statistic(s, value_of(summary, s), summary) for s in shown),
            _share(nees.outside),
            _share(nis.outside),
        ],
    }


def rmse(entries: Sequence[Entry]) -> list[dict[str, Any]]:
    """Rows of the table of RMSE and σ: the statistics of each coordinate, entry by entry."""
    source = entries[0].source
    rows = []
    for i, (name, unit) in enumerate(zip(source.names, source.units)):
        cells = [
            _statistic(s, value_of(entry.summary, s)[i], entry.summary)
            for entry in entries
            for s in statistics.shown("report", "coordinate", [e.summary for e in entries])
        ]
        rows.append({"name": name, "unit": unit, "cells": cells})
    return rows


def by_phase(entries: Sequence[Entry]) -> Table | None:
    """The statistics by phase of contact; None without contacts."""
    return phases.table(
        (e.key, phase_statistics(e.record, e.source.units, e.source.level)) for e in entries
    )


def baselines(entries: Sequence[Entry]) -> list[dict[str, Any]]:
    """One table per baseline: one row per quantity, one column per other entry."""
    out = []
    names, units = entries[0].source.names, entries[0].source.units
    found, level = differences(entries), entries[0].source.level
    for baseline in entries if found else []:
        b = baseline.summary
        pairs = [d for d in found if d.baseline == baseline.key]
        rows = [
            ("RMSE, all coordinates", "ratio", [_ratio(d.score) for d in pairs]),
            ("p, Wilcoxon", "Holm", [_p(d.score.wilcoxon) for d in pairs]),
            ("p, sign test", "Holm", [_p(d.score.sign) for d in pairs]),
            ("runs less / more / same", "", [_counts(d.score.paired) for d in pairs]),
            (COST.heading, "ratio", [_cell(d.cost, number(d.cost)) for d in pairs]),
            ("NEES/n", "", [_difference(d.nees, b.anees.value, d.p[0], level) for d in pairs]),
        ]
        for i, (name, unit) in enumerate(zip(names, units)):
            scale = b.rmse[i].value
            cells = [_difference(d.rmse[i], scale, d.p[1 + i], level) for d in pairs]
            rows.append((name, unit, cells))
        rows.append(
            ("runs neither lost", "", [_cell(d.nees.runs, f"{d.nees.runs}") for d in pairs])
        )
        out.append({"key": baseline.key, "pairs": pairs, "rows": rows})
    return out


def _p(p: float) -> dict[str, Any]:
    return _cell(p, probability(p))


def _ratio(pair: Pair) -> dict[str, Any]:
    """The ratio of RMSE over all coordinates, coloured if the two differ."""
    kind = _side(pair.paired.effect) if pair.differ else ""
    return _cell(pair.ratio.value, bounds(pair.ratio) + MARKS[kind], kind)


def _counts(p: Paired) -> dict[str, Any]:
    return _cell(p.less, f"{p.less} / {p.more} / {p.ties}")


def _difference(d: Paired, scale: float, p: float, level: float) -> dict[str, Any]:
    """The cell of a difference, coloured if it is significant and larger than the margin."""
    i = d.difference
    told = p < 1 - level and i.value * np.sign(d.effect) > MARGIN * abs(scale)
    kind = _side(d.effect) if told else ""
    none = max(abs(i.low), abs(i.high)) < NONE * abs(scale)
    return _cell(i.value, "≈ 0" if none else quantity(i) + MARKS[kind], kind, p)


def _side(effect: float) -> str:
    return "less" if effect < 0 else "more"


def outside(
    entries: Sequence[Entry], statistics: Sequence[TraceStatistics | None]
) -> list[dict[str, Any]]:
    """Rows of the table of shares of NEES and NIS values outside the band of one run."""
    return [
        {"key": e.key, "cells": [_share(share) for share in t.outside]}
        for e, t in zip(entries, statistics)
        if t is not None
    ]


def white(material: Material) -> dict[str, Any]:
    """The table of lag-one correlations and of Ljung and Box's test, together and by channel."""
    names = list(dict.fromkeys(name for found in material.channels for name in found))
    if any(material.white):
        names.insert(0, "all channels" if names else "")
    rows = []
    for entry, one, channels in zip(material.entries, material.white, material.channels):
        cells = [_statistic(LAG_ONE, entry.summary.lag_one, entry.summary)]
        for name in names:
            found = one if name in ("", "all channels") else channels.get(name)
            cells += _test(found)
        rows.append({"key": entry.key, "cells": cells})
    return {"groups": names, "rows": rows}


def _test(found: Correlation | None) -> list[dict[str, Any]]:
    if found is None:
        return [_cell(np.nan, "–"), _cell(np.nan, "–")]
    rejected, p = found.found.rejected, found.found.p
    return [_cell(rejected.value, percent(rejected)), _cell(p, probability(p))]


def notices(entries: Sequence[Entry], statistics: Sequence[TraceStatistics | None]) -> list[str]:
    """Warnings at the top of the page: unfinished stores, several versions, missing traces."""
    out = []
    for source in {id(e.source): e.source for e in entries}.values():
        if len(source.runs) < source.total:
            out.append(
                f"{source.title} is unfinished: {len(source.runs)} of {source.total} runs are done."
            )
        if source.log is not None:
            missing = (
                ""
                if source.has_truth
                else (
                    " The truth is not known: the verdict is of the innovations, and what needs "
                    "the truth is left out."
                )
            )
            out.append(
                f"{source.title} is a replay of the {source.origin.split(', one run')[0]}, which "
                f"is one run: parts of its time take the place of runs.{missing}"
            )
        if said := mixed(known(source.attrs)):
            out.append(f"{source.title}: {said}.")
    bare = [e.source.title for e, t in zip(entries, statistics) if t is None]
    if bare:
        out.append(
            f"{', '.join(dict.fromkeys(bare))} kept no traces: the error of single runs, "
            "distributions, the autocorrelation of NIS, videos and the time of divergence need "
            "`estbench run --keep diagonal`."
        )
    return out
