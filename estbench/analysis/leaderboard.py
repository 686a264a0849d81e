"""The reference results: every bundled robot, every main estimator, one table each."""

import csv
import io
import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from estbench.analysis import tables
from estbench.analysis.comparison import Rank, compare, score
from estbench.analysis.findings import Accuracy, accuracies
from estbench.analysis.shown import few_runs
from estbench.analysis.tables import Table, bounds, number, percent
from estbench.consistency.summary import Summary
from estbench.errors import AnalysisError, DimensionError, EstimatorError, StoreError
from estbench.experiment import setup
from estbench.montecarlo import run as experiment
from estbench.montecarlo.results import Results
from estbench.scenario.load import bundled
from estbench.store.template import provenance
from estbench.tables.quantity import quantity

RUNS = 60
"""By default: all of it takes minutes on two cores, and NEES/n is known to a few percent."""
MARGIN = 0.01
MAIN = (
    "kf", "lkf", "ekf", "iekf", "sr_ekf", "cd_ekf", "ukf", "sr_ukf", "ckf", "ghkf", "enkf", "pf",
    "imm", "robust_ekf", "adaptive_ekf",
)  # fmt: skip
"""Estimators that need no setting to be run on any robot."""
LARGEST = {"pf": 2}
"""Most coordinates with which an estimator is of use: particles needed grow exponentially."""


@dataclass(frozen=True, eq=False)
class Board:
    """One robot.

    Attributes:
        name: the scenario's.
        results: of all its estimators.
        ranks: in order.
        skipped: estimator -> why it does not suit.
    """

    name: str
    results: Results
    ranks: tuple[Rank, ...]
    skipped: dict[str, str]

    def accuracy(self, label: str) -> tuple[Accuracy, ...]:
        """RMSE of each unit's coordinates together."""
        r = self.results
        level = r.scenario.consistency.level
        return accuracies(r.records[label], r.names, r.units, level, 0.02)


def play(
    name: str,
    runs: int = RUNS,
    estimators: Sequence[str] = MAIN,
    workers: int | None = None,
    duration: float | None = None,
) -> Board:
    """Run the estimators that suit on a bundled scenario with its own seed.

    Args:
        name: the scenario.
        runs: how many.
        estimators: names; one that cannot be built on this robot is skipped.
        workers: default the CPUs there are.
        duration: s; default the scenario's.

    Raises:
        AnalysisError: none of them suits.
        KeyboardInterrupt: it was interrupted; half a table is none.
    """
    skipped: dict[str, str] = {}
    chosen = []
    for label in estimators:
        resolved = experiment.resolve(name, [label], runs=runs, duration=duration)
        try:
            n = setup.build(resolved).space.n
        except (EstimatorError, DimensionError) as error:
            skipped[label] = str(error)
            continue
        if n > LARGEST.get(label, n):
            skipped[label] = f"{n} coordinates are too many for it"
            continue
        chosen.append(label)
    if not chosen:
        raise AnalysisError(f"{name}: no estimator suits: {skipped}")
    results = experiment.run(
        name, chosen, runs=runs, duration=duration, keep="summary", workers=workers,
        batch_size=min(250, max(10, -(-runs // 2))),  # fewer batches, less overhead; same results
    )  # fmt: skip
    if results.interrupted:
        raise KeyboardInterrupt
    scores = {
        label: score(r["mse"], r["diverged"].astype(bool)) for label, r in results.records.items()
    }
    _, ranks = compare(scores, results.scenario.consistency.level, MARGIN)
    return Board(name, results, tuple(ranks), skipped)


def write(boards: Sequence[Board], out: Path) -> tuple[Path, Path]:
    """Write `leaderboard.md` and `leaderboard.csv` into a folder, and say where they are.

    Raises:
        StoreError: it cannot be written.
    """
    files = (out / "leaderboard.md", markdown(boards)), (out / "leaderboard.csv", to_csv(boards))
    try:
        out.mkdir(parents=True, exist_ok=True)
        for path, content in files:
            path.write_text(content, encoding="utf-8")
    except OSError as error:
        raise StoreError(f"{out} cannot be written: {error.strerror or error}") from None
    return files[0][0], files[1][0]


def reproduce(
    out: Path,
    runs: int = RUNS,
    scenarios: Sequence[str] = (),
    estimators: Sequence[str] = MAIN,
    workers: int | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> tuple[Path, Path]:
    """Regenerate the reference results.

    Args:
        out: folder.
        runs: of each robot.
        scenarios: bundled names; default the robots, without their variants.
        estimators: names.
        workers: default the CPUs there are.
        say: told what is being done.

    Raises:
        AnalysisError: a setting is out of range, or no such scenario.
        StoreError: the folder cannot be written.
    """
    if runs < 2:
        raise AnalysisError(f"runs is {runs}; a comparison needs at least 2")
    names = scenarios or robots()
    for name in names:
        experiment.resolve(name, runs=runs)  # refuses it before the others have been run
    boards = []
    for name in names:
        say(f"{name}: {runs} runs of {len(estimators)} estimators")
        boards.append(play(name, runs, estimators, workers))
    return write(boards, out)


def robots() -> list[str]:
    """The bundled scenarios that are a robot's own; the others are variants of one."""
    return sorted(name for name, path in bundled().items() if path.stem == "scenario")


def markdown(boards: Sequence[Board]) -> str:
    """The tables, with what it takes to make them again."""
    first = boards[0].results
    versions = provenance(first.scenario)["versions"]
    shown = ", ".join(f"{name} {version}" for name, version in versions.items())
    head = [
        "# Leaderboard",
        f"Made by `estbench reproduce --runs {len(first.runs)}`; the same command gives the same "
        f"numbers, except for cost.\n{shown}; {processor()}.",
        f"RMSE is of the norm of all coordinates of a unit, over time and the runs that did not "
        f"diverge; ± and brackets are {first.scenario.consistency.level:.0%} intervals across "
        "runs. Rank: by the geometric mean over the coordinates of RMSE, which `/ first` compares; "
        f"= is a tie (Wilcoxon's test, Holm over all pairs, or a difference below {MARGIN:.0%}); "
        "the ranks of all estimators are at once in the ranges named. "
        "NEES/n is 1 for a consistent filter. Cost is of one core, in µs per run and step; it "
        "depends on the machine and on what else it does. What the words mean: "
        "[docs/statistics.md](../docs/statistics.md).",
    ]
    parts = ["\n\n".join(head)]
    for board in boards:
        parts.append(f"## {_title(board)}\n\n{board.results.scenario.description}")
        parts.append(tables.markdown([_table(board)]).split("\n", 2)[2])
        level = board.results.scenario.consistency.level
        if warning := few_runs(len(board.results.runs), len(board.ranks), level).strip():
            parts.append(warning)
        if board.skipped:
            parts.append("\n".join(f"- not `{k}`: {v}" for k, v in board.skipped.items()))
    return "\n\n".join(parts) + "\n"


def _title(board: Board) -> str:
    r = board.results
    return (
        f"{board.name}: {len(r.runs)} runs x {r.times[-1]:g} s ({r.length}), "
        f"seed {r.scenario.simulation.seed}"
    )


def _table(board: Board) -> Table:
    units = dict.fromkeys(board.results.units)
    rows = []
    for i, rank in enumerate(board.ranks):
        s = board.results[rank.key]
        rows.append(
            (
                f"{rank.place}{'=' if rank.tied else ''}", f"{rank.place}–{rank.last}", s.label,
                str(s.verdict), "1" if i == 0 else bounds(rank.ratio), quantity(s.anees),
                percent(s.diverged_interval),
                *(quantity(a.mean) for a in board.accuracy(s.label)), number(s.cost),
            )
        )  # fmt: skip
    columns = (
        "rank", "in ranks", "<estimator", "<verdict", "/ first", "NEES/n", "diverged",
        *(f"RMSE [{unit}]" for unit in units), "cost [µs]",
    )  # fmt: skip
    return Table(board.name, columns, tuple(rows))


UNITS = {"m": "m", "rad": "rad", "m/s": "m_per_s", "rad/s": "rad_per_s"}
"""As they are written in a column's name."""


def to_csv(boards: Sequence[Board]) -> str:
    """One row a robot and estimator; a cell is empty where the robot has no such coordinate."""
    units = list(dict.fromkeys(unit for board in boards for unit in board.results.units))
    rmse = {unit: f"rmse_{UNITS.get(unit, unit.replace('/', '_per_'))}" for unit in units}
    names = [f"{c}{end}" for c in rmse.values() for end in ("", "_low", "_high")]
    columns = [
        "scenario", "seed", "runs", "duration_s", "steps", "estimator", "rank", "last_rank",
        "tied", "verdict", "rmse_ratio_to_first", "anees_over_n", "anees_over_n_low",
        "anees_over_n_high", "anees_over_n_median", "anis_over_m", "innovation_lag_one",
        "diverged_share", "diverged_low", "diverged_high", *names, "cost_us_per_run_step",
    ]  # fmt: skip
    versions = list(provenance(boards[0].results.scenario)["versions"])
    file = io.StringIO()
    writer = csv.DictWriter(file, [*columns, *versions], restval="", lineterminator="\n")
    writer.writeheader()
    for board in boards:
        for rank in board.ranks:
            writer.writerow(_row(board, rank, board.results[rank.key], rmse))
    return file.getvalue()


def _row(board: Board, rank: Rank, s: Summary, rmse: dict[str, str]) -> dict[str, Any]:
    r = board.results
    row: dict[str, Any] = {
        "scenario": board.name, "seed": r.scenario.simulation.seed, "runs": len(r.runs),
        "duration_s": f"{r.times[-1]:g}", "steps": len(r.times) - 1, "estimator": s.label,
        "rank": rank.place, "last_rank": rank.last, "tied": int(rank.tied),
        "verdict": str(s.verdict), "rmse_ratio_to_first": _cell(rank.ratio.value),
        "anees_over_n": _cell(s.anees.value), "anees_over_n_low": _cell(s.anees.low),
        "anees_over_n_high": _cell(s.anees.high), "anees_over_n_median": _cell(s.anees_median),
        "anis_over_m": _cell(s.anis.value), "innovation_lag_one": _cell(s.lag_one.value),
        "diverged_share": _cell(s.diverged), "diverged_low": _cell(s.diverged_interval.low),
        "diverged_high": _cell(s.diverged_interval.high),
        "cost_us_per_run_step": f"{s.cost:.3g}",
        **provenance(r.scenario)["versions"],
    }  # fmt: skip
    for a in board.accuracy(s.label):
        for end, value in (("", a.mean.value), ("_low", a.mean.low), ("_high", a.mean.high)):
            row[rmse[a.unit] + end] = _cell(value)
    return row


def _cell(x: float) -> str:
    """Six digits: more than the intervals leave, and the same on every machine."""
    return f"{x:.6g}" if np.isfinite(x) else ""


def processor() -> str:
    """The processor's name, for the cost."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
