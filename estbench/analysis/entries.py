"""An estimator of somebody else on the reference scenarios: its rows in a table of entries."""

import csv
import io
import math
import os
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, distribution, version
from pathlib import Path
from typing import Any

from estbench.analysis.board import Board
from estbench.analysis.leaderboard import RUNS, WHOLE, play, robots
from estbench.consistency.intervals import Interval
from estbench.errors import AnalysisError, EstbenchError, did_you_mean
from estbench.estimators import registry
from estbench.estimators.names import BUILTIN, GROUP, known
from estbench.experiment.setup import build
from estbench.logs.replay import Replayed, replay
from estbench.scenario.load import resolve
from estbench.store.template import provenance
from estbench.store.versions import installed
from estbench.tables import writers
from estbench.tables.columns import Table, tabulate
from estbench.tables.destination import check_file

FEW = 10
"""Default count of runs of a robot of more than `WHOLE` coordinates."""
REFERENCE = "ekf"
"""Beside which an estimator is ranked; a robot with contact has its own, the first of its file."""
COLUMNS = (
    "scenario", "log", "estimator", "package", "package_version", "seed", "runs", "duration_s",
    "verdict", "reference", "rmse_ratio", "rmse_ratio_low", "rmse_ratio_high", "anees_over_n",
    "anees_over_n_low", "anees_over_n_high", "anis_over_m", "log_likelihood", "diverged_share",
    "efficiency", "cost_us_per_run_step", "note", *installed(),
)  # fmt: skip
_LOGS = ("real_pendulum", "real_double_pendulum")
"""Scenarios with recorded logs; the logs of each are in a folder of its name."""


def estimators_of(package: str) -> dict[str, str]:
    """Label -> `module:Name` or registered name of what a package, or a name, brings.

    Args:
        package: an installed distribution with entry points of the group `estbench.estimators`, a
            registered estimator, or `module:Name`.

    Raises:
        AnalysisError: the distribution has no such entry point, or there is none.
        EstimatorError: `module:Name` cannot be imported, or is no estimator.
    """
    if ":" in package:
        registry.resolve(package)
        return {package.rpartition(":")[2]: package}
    try:
        points = distribution(package).entry_points.select(group=GROUP)
    except (PackageNotFoundError, ValueError):
        if package in known():
            return {package: package}
        hint = did_you_mean(package, known())
        raise AnalysisError(
            f"no installed package or estimator '{package}'{hint}; install it, or use module:Name"
        ) from None
    if not points:
        raise AnalysisError(
            f"package '{package}' has no entry point of the group '{GROUP}'; add one, or "
            "use module:Name"
        )
    return {point.name: point.value for point in points}


def enter(
    package: str,
    out: Path,
    runs: int | None = None,
    scenarios: Sequence[str] = (),
    logs: Path | None = None,
    workers: int | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> list[dict[str, Any]]:
    """Run the estimators of a package and append their rows to a CSV file.

    Each runs beside the reference of the scenario, on the same truth and readings. The table of
    all rows is written beside the file, as Markdown.

    Args:
        package: as `estimators_of`.
        out: the CSV file; it may exist.
        runs: of each robot; default 60, and 10 for one of more than 24 coordinates.
        scenarios: bundled names; default the robots.
        logs: folder with the recorded logs of each scenario in a folder of its name.
        workers: default the CPUs this process may use.
        say: called with a line about each robot.

    Returns:
        The rows.

    Raises:
        AnalysisError: a setting is out of range, or the file has other columns.
        EstbenchError: as `estimators_of`.
    """
    if runs is not None and runs < 2:
        raise AnalysisError(f"runs is {runs}; a comparison needs at least 2")
    found = estimators_of(package)
    check_file(out)
    before = _read(out)
    names = scenarios or robots()
    for name in names:
        resolve(name)  # raises before any robot is run
    rows = []
    for label, target in found.items():
        for name in names:
            say(f"{label} on {name}")
            rows.append(_simulated(name, label, target, package, runs, workers))
        rows += [
            _recorded(name, label, target, package, file, say) for name, file in recordings(logs)
        ]
    _write(out, [*before, *rows])
    return rows


def recordings(folder: Path | None) -> list[tuple[str, Path]]:
    """(scenario, file) of the recorded logs in a folder; none without one.

    Raises:
        AnalysisError: there is no log in it.
    """
    if folder is None:
        return []
    found = [(name, file) for name in _LOGS for file in sorted((folder / name).glob("*.csv"))]
    if not found:
        raise AnalysisError(f"--logs {folder} has no {' or '.join(f'{n}/*.csv' for n in _LOGS)}")
    return found


def _simulated(
    name: str, label: str, target: str, package: str, runs: int | None, workers: int | None
) -> dict[str, Any]:
    """The row of one robot; an estimator that does not fit it gets a note."""
    row = _named(name, label, package)
    try:
        size = build(resolve(name, [target])).space.n
        own = list(resolve(name).estimators)
        beside = own[0] if size > WHOLE else REFERENCE
        count = runs or (FEW if size > WHOLE else RUNS)
        board = play(name, count, list(dict.fromkeys((beside, target))), workers,
            largest=math.inf)  # fmt: skip
    except EstbenchError as error:
        return row | {"note": " ".join(str(error).split())}
    if target in board.skipped:
        return row | {"note": board.skipped[target]}
    shown = target.rpartition(":")[2]
    return row | _numbers(board, shown, beside)


def _numbers(board: Board, label: str, beside: str) -> dict[str, Any]:
    results = board.results
    summary = results[label]
    simulation = results.scenario.simulation
    row = {
        "seed": simulation.seed, "runs": len(results.runs), "duration_s": f"{results.times[-1]:g}",
        "verdict": str(summary.verdict), "anees_over_n": summary.anees.value,
        "anees_over_n_low": summary.anees.low, "anees_over_n_high": summary.anees.high,
        "anis_over_m": summary.anis.value, "log_likelihood": summary.log_likelihood.value,
        "diverged_share": summary.diverged, "efficiency": summary.efficiency.value,
        "cost_us_per_run_step": summary.cost, "note": summary.reason,
        **provenance(results.scenario)["versions"],
    }  # fmt: skip
    if label != beside:
        ratio = _ratio(board, label)
        row |= {"reference": beside, "rmse_ratio": ratio.value, "rmse_ratio_low": ratio.low,
                "rmse_ratio_high": ratio.high}  # fmt: skip
    return row


def _ratio(board: Board, label: str) -> Interval:
    """RMSE of the estimator over that of the other one of two, paired run by run."""
    _, second = board.ranks
    if second.key == label:
        return second.ratio
    r = second.ratio
    return Interval(1.0 / r.value, 1.0 / r.high, 1.0 / r.low)


def _recorded(
    name: str, label: str, target: str, package: str, file: Path, say: Callable[[str], None]
) -> dict[str, Any]:
    """The row of one log, where there is no truth: the innovations alone."""
    say(f"{label} on {file.name} of {name}")
    row = _named(name, label, package) | {"log": file.stem, "runs": 1}
    try:
        (found,) = replay(name, file, [target]).replayed
    except EstbenchError as error:
        return row | {"note": " ".join(str(error).split())}
    return row | _of_log(found)


def _of_log(found: Replayed) -> dict[str, Any]:
    return {
        "verdict": str(found.innovations.verdict), "anis_over_m": found.innovations.nis.value,
        "log_likelihood": found.log_likelihood,
        "cost_us_per_run_step": 1e6 * found.seconds / max(found.updates, 1),
        "note": found.failure, **installed(),
    }  # fmt: skip


def _named(name: str, label: str, package: str) -> dict[str, Any]:
    """The first cells; the version of code that is no installed package is unknown."""
    top = package.partition(":")[0].partition(".")[0]
    try:
        known = version(package if ":" not in package else top)
    except (PackageNotFoundError, ValueError):
        known = version("estbench") if package in BUILTIN else ""
    return {"scenario": name, "estimator": label, "package": package, "package_version": known}


def _read(file: Path) -> list[dict[str, Any]]:
    """The rows of the file; none if it does not exist."""
    if not file.exists():
        return []
    with file.open(newline="", encoding="utf-8") as stream:
        reader = csv.DictReader(stream)
        if missing := [c for c in COLUMNS[:10] if c not in (reader.fieldnames or ())]:
            raise AnalysisError(
                f"{file} has no column '{missing[0]}': it is no table of entries; choose another "
                "--out"
            )
        return list(reader)


def _write(file: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write the CSV file and the Markdown beside it, each whole or not at all."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, restval="", extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows({k: _cell(v) for k, v in row.items()} for row in rows)
    for path, content in ((file, text.getvalue()), (file.with_suffix(".md"), markdown(rows))):
        draft = path.with_name(f".{path.name}.draft")
        draft.write_text(content, encoding="utf-8")
        os.replace(draft, path)


def _cell(value: Any) -> Any:
    return f"{value:.6g}" if isinstance(value, float) else value


def markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """The table of the entries as a page."""
    head = (
        "# Entries\n\nEstimators of others on the reference scenarios and the recorded logs, by "
        "`estbench leaderboard PACKAGE`. RMSE ratio: to that of the reference on the same runs, "
        "geometric mean over the coordinates, with the 95% interval. A log has no "
        "truth: its verdict is of the innovations. µs/step: of one core, per run; on "
        "a log by the wall clock.\n\n"
    )
    packages = dict.fromkeys(
        f"- `{row['estimator']}`: {row['package']} {row['package_version']}".rstrip()
        + (f", estbench {row['estbench']}" if row.get("estbench") else "")
        for row in rows
        if row.get("verdict")
    )
    parts = [head + writers.markdown([table(rows)]).split("\n", 2)[2], "\n".join(packages)]
    if lost := [f"- {place(r)}, `{r['estimator']}`: {r['note']}" for r in rows if _unrun(r)]:
        parts.append("Not run:\n\n" + "\n".join(lost))
    return "\n\n".join(part for part in parts if part) + "\n"


def place(row: Mapping[str, Any]) -> str:
    """The scenario, and the log where there is one."""
    return str(row["scenario"]) + (f", {row['log']}" if row.get("log") else "")


def _unrun(row: Mapping[str, Any]) -> bool:
    return not row.get("verdict") and bool(row.get("note"))


def table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """The entries as a table."""
    body = []
    for row in rows:
        bounds = [_short(row.get(k)) for k in ("rmse_ratio_low", "rmse_ratio_high")]
        ratio = _short(row.get("rmse_ratio"))
        body.append([
            place(row), str(row["estimator"]), str(row.get("verdict") or "not run"),
            str(row.get("runs", "")),
            f"{ratio} [{bounds[0]}, {bounds[1]}]" if ratio else "", str(row.get("reference", "")),
            _short(row.get("anees_over_n")), _short(row.get("anis_over_m")),
            _short(row.get("cost_us_per_run_step")),
        ])  # fmt: skip
    headings = (
        "<scenario", "<estimator", "<verdict", "runs", "RMSE ratio", "to", "NEES/n", "NIS/m",
        "µs/step",
    )  # fmt: skip
    return tabulate("entries", headings, body)


def _short(value: Any) -> str:
    if value in (None, ""):
        return ""
    x = float(value)
    return f"{x:.0f}" if abs(x) >= 100 else f"{x:.3g}"
