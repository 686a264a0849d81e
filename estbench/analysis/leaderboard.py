"""The reference results: every bundled robot, every main estimator, one table per robot."""

from collections.abc import Callable, Sequence
from pathlib import Path

from estbench.analysis.board import MARGIN, Board, markdown, to_csv
from estbench.analysis.comparison import compare
from estbench.consistency.scores import score
from estbench.errors import AnalysisError, DimensionError, EstimatorError, StoreError
from estbench.experiment.setup import build
from estbench.montecarlo.run import run
from estbench.scenario.files import bundled
from estbench.scenario.load import resolve

RUNS = 60
"""Default count of runs: minutes on two cores; NEES/n is known to a few percent."""
MAIN = (
    "kf", "lkf", "ekf", "iekf", "sr_ekf", "cd_ekf", "ukf", "sr_ukf", "ckf", "ghkf", "enkf", "pf",
    "imm", "robust_ekf", "adaptive_ekf",
)  # fmt: skip
"""Estimators that run on any robot without settings."""
LARGEST = {"pf": 2}
"""Most coordinates for an estimator: the particles needed grow exponentially with them."""
WHOLE = 24
"""Most coordinates for the main estimators; with 32 and contact, all of them take hours."""


def play(
    name: str,
    runs: int = RUNS,
    estimators: Sequence[str] = (),
    workers: int | None = None,
    duration: float | None = None,
    largest: float = WHOLE,
) -> Board:
    """Run the suitable estimators on a bundled scenario with its own seed.

    Args:
        name: the scenario.
        runs: count of runs.
        estimators: names; one that cannot be built on this robot, or would take hours, is skipped.
            Default `MAIN`, and those of the scenario.
        workers: default the CPUs this process may use.
        duration: s; default the scenario's.
        largest: most coordinates for an estimator that is not one of the scenario's.

    Raises:
        AnalysisError: none of them suits.
        KeyboardInterrupt: it was interrupted; no partial table is made.
    """
    skipped: dict[str, str] = {}
    chosen = []
    own = resolve(name).estimators
    for label in estimators or dict.fromkeys((*MAIN, *own)):
        resolved = resolve(name, [label], runs=runs, duration=duration)
        try:
            n = build(resolved).space.n
        except (EstimatorError, DimensionError) as error:
            skipped[label] = str(error)
            continue
        if n > LARGEST.get(label, n if label in own else largest):
            skipped[label] = f"{n} coordinates are too many for it"
            continue
        chosen.append(label)
    if not chosen:
        raise AnalysisError(f"{name}: no estimator suits: {skipped}")
    results = run(
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
    """Write `leaderboard.md` and `leaderboard.csv` into a folder, and return their paths.

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
    estimators: Sequence[str] = (),
    workers: int | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> tuple[Path, Path]:
    """Regenerate the reference results.

    Args:
        out: folder.
        runs: of each robot.
        scenarios: bundled names; default the robots, without their variants.
        estimators: names; default as in `play`.
        workers: default the CPUs this process may use.
        say: called with a line about each robot.

    Raises:
        AnalysisError: a setting is out of range, or no such scenario.
        StoreError: the folder cannot be written.
    """
    if runs < 2:
        raise AnalysisError(f"runs is {runs}; a comparison needs at least 2")
    names = scenarios or robots()
    for name in names:
        resolve(name, runs=runs)  # raises before any robot is run
    boards = []
    for name in names:
        say(f"{name}: {runs} runs")
        boards.append(play(name, runs, estimators, workers))
    return write(boards, out)


def robots() -> list[str]:
    """The bundled scenarios named as their robot; the others are variants."""
    return sorted(name for name, path in bundled().items() if path.stem == "scenario")
