"""The leaderboard as Markdown and as CSV."""

import platform
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from estbench.analysis.comparison import Rank
from estbench.analysis.findings import Accuracy, accuracies
from estbench.analysis.shown import few_runs
from estbench.consistency import statistics
from estbench.consistency.declaration import Statistic
from estbench.consistency.intervals import Interval
from estbench.consistency.statistics import COST, RMSE, Summary
from estbench.montecarlo.results import Results
from estbench.store.template import provenance
from estbench.tables import writers
from estbench.tables.cells import LOST_NOTE, estimate, of_summary, value_of
from estbench.tables.columns import Table, tabulate
from estbench.tables.quantity import bounds

MARGIN = 0.01
"""A relative difference of RMSE that is too small to matter."""


@dataclass(frozen=True, eq=False)
class Board:
    """The results of one robot.

    Attributes:
        name: of the scenario.
        results: of all its estimators.
        ranks: in order.
        skipped: estimator -> why it is not suitable.
    """

    name: str
    results: Results
    ranks: tuple[Rank, ...]
    skipped: dict[str, str]

    def accuracy(self, label: str) -> tuple[Accuracy, ...]:
        """RMSE of the coordinates of each unit together."""
        r = self.results
        level = r.scenario.consistency.level
        return accuracies(r.records[label], r.names, r.units, level, 0.02)


def markdown(boards: Sequence[Board]) -> str:
    """The tables, with the command and the versions that reproduce them."""
    first = boards[0].results
    versions = provenance(first.scenario)["versions"]
    shown = ", ".join(f"{name} {version}" for name, version in versions.items())
    head = [
        "# Leaderboard",
        f"Made by `estbench reproduce --runs {len(first.runs)}`; the same command gives the same "
        f"numbers, except for cost.\n{shown}; {processor()}.",
        "RMSE is of the norm of all coordinates of a unit, over time and the runs that did not "
        f"diverge ({LOST_NOTE}); ± and brackets are {first.scenario.consistency.level:.0%} "
        "intervals across runs. Rank: by the geometric mean over the coordinates of RMSE, which "
        "`/ first` compares; "
        f"= is a tie (Wilcoxon's test, Holm over all pairs, or a difference below {MARGIN:.0%}); "
        "the ranks of all estimators are at once in the ranges named. "
        f"{statistics.ideals('board')} for a consistent filter. {COST.heading} is of one core, per "
        "run and step; it depends on the machine and on what else it does. What the words mean: "
        "[docs/statistics.md](../docs/statistics.md).",
    ]
    parts = ["\n\n".join(head)]
    for board in boards:
        parts.append(f"## {_title(board)}\n\n{board.results.scenario.description}")
        parts.append(writers.markdown([_table(board)]).split("\n", 2)[2])
        level = board.results.scenario.consistency.level
        if warning := few_runs(len(board.results.runs), len(board.ranks), level).strip():
            parts.append(warning)
        if board.skipped:
            why: dict[str, list[str]] = {}
            for label, reason in board.skipped.items():
                why.setdefault(reason, []).append(f"`{label}`")
            parts.append("\n".join(f"- not {', '.join(v)}: {k}" for k, v in why.items()))
    return "\n\n".join(parts) + "\n"


def _title(board: Board) -> str:
    r = board.results
    return (
        f"{board.name}: {len(r.runs)} runs x {r.times[-1]:g} s ({r.length}), "
        f"seed {r.scenario.simulation.seed}"
    )


def _table(board: Board) -> Table:
    units = tuple(dict.fromkeys(board.results.units))
    rows = []
    for i, rank in enumerate(board.ranks):
        summary = board.results[rank.key]
        cells = (
            of_summary(summary, s, value, s.places["board"])
            for s in _statistics("board")
            for value in _values(board, summary, s)
        )
        rows.append(
            (
                f"{rank.place}{'=' if rank.tied else ''}", f"{rank.place}–{rank.last}",
                summary.label, str(summary.verdict), "1" if i == 0 else bounds(rank.ratio), *cells,
            )
        )  # fmt: skip
    headings = (
        heading
        for s in _statistics("board")
        for heading in (
            [f"{s.heading} [{unit}]" for unit in units] if s is RMSE else [s.heading_in("board")]
        )
    )
    columns = ("rank", "in ranks", "<estimator", "<verdict", "/ first", *headings)
    return tabulate(board.name, columns, rows)


def _statistics(place: Literal["board", "board_csv"]) -> list[Statistic]:
    """The statistics of the leaderboard: one value per estimator, RMSE one per unit."""
    return [s for s in statistics.STATISTICS if place in s.places and (s.per == "run" or s is RMSE)]


def _values(board: Board, summary: Summary, s: Statistic) -> list[Interval | float]:
    """The value of a statistic, or those of RMSE by unit."""
    if s is RMSE:
        return [a.mean for a in board.accuracy(summary.label)]
    return [value_of(summary, s)]


UNITS = {"m": "m", "rad": "rad", "m/s": "m_per_s", "rad/s": "rad_per_s"}
"""Units in column names."""


def to_csv(boards: Sequence[Board]) -> str:
    """One row per robot and estimator; a cell is empty where the robot has no such coordinate."""
    units = list(dict.fromkeys(unit for board in boards for unit in board.results.units))
    found = [
        name
        for s in _statistics("board_csv")
        for stem in ([_rmse(unit) for unit in units] if s is RMSE else [s.json_key])
        for name in _names(s, stem)
    ]
    columns = [
        "scenario", "seed", "runs", "duration_s", "steps", "estimator", "rank", "last_rank",
        "tied", "verdict", "rmse_ratio_to_first", *found,
    ]  # fmt: skip
    versions = list(provenance(boards[0].results.scenario)["versions"])
    rows = (_row(board, rank, board.results[rank.key]) for board in boards for rank in board.ranks)
    return writers.comma_separated([*columns, *versions], rows)


def _rmse(unit: str) -> str:
    """The column of the RMSE of a unit."""
    return f"{RMSE.json_key}_{UNITS.get(unit, unit.replace('/', '_per_'))}"


def _names(s: Statistic, stem: str) -> tuple[str, ...]:
    """The columns of a statistic: its value, and the ends of its interval where it is shown."""
    if s.places["board_csv"] == "brief":
        return (stem,)
    ends = stem.removesuffix("_share")
    return stem, f"{ends}_low", f"{ends}_high"


def _row(board: Board, rank: Rank, summary: Summary) -> dict[str, Any]:
    r = board.results
    row: dict[str, Any] = {
        "scenario": board.name, "seed": r.scenario.simulation.seed, "runs": len(r.runs),
        "duration_s": f"{r.times[-1]:g}", "steps": r.instants, "estimator": summary.label,
        "rank": rank.place, "last_rank": rank.last, "tied": int(rank.tied),
        "verdict": str(summary.verdict), "rmse_ratio_to_first": _cell(rank.ratio.value),
        **provenance(r.scenario)["versions"],
    }  # fmt: skip
    for s in _statistics("board_csv"):
        units = [a.unit for a in board.accuracy(summary.label)] if s is RMSE else [""]
        for unit, value in zip(units, _values(board, summary, s), strict=True):
            stem = _rmse(unit) if s is RMSE else s.json_key
            ends = [value.low, value.high] if isinstance(value, Interval) else []
            for name, number in zip(_names(s, stem), [estimate(value), *ends]):
                row[name] = f"{number:.3g}" if s is COST else _cell(number)
    return row


def _cell(x: float) -> str:
    """Six digits: more than the intervals justify, and the same on every machine."""
    return f"{x:.6g}" if np.isfinite(x) else ""


def processor() -> str:
    """The processor's name, for the cost."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
