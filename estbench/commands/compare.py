"""The commands `compare` and `reproduce`; what they need is imported when they run."""

import time
from pathlib import Path
from typing import Annotated

import typer

from estbench.commands.shared import Format, console, say


def register(app: typer.Typer) -> None:
    """Add the commands to the application."""
    app.command(epilog="Example: estbench compare results/a results/b --format markdown")(compare)
    app.command(epilog="Example: estbench reproduce --runs 200")(reproduce)


def compare(
    folders: Annotated[
        list[Path], typer.Argument(help="results folders of one robot, or a folder of them")
    ],
    format_: Format = "text",
    margin: Annotated[
        float, typer.Option(help="relative difference that is too small to matter")
    ] = 0.01,
    precision: Annotated[
        float, typer.Option(help="half-width wanted; the runs needed for it are shown")
    ] = 0.02,
) -> None:
    """Compare estimators run by run: accuracy, ranking with ties, coverage, credibility."""
    from estbench.analysis.compare import compare_stores
    from estbench.analysis.formats import render
    from estbench.tables import formats

    formats.check(format_)
    compared = compare_stores(folders, margin, precision)
    print(render(compared, format_, console().width).rstrip("\n"))


def reproduce(
    out: Annotated[Path, typer.Option(help="folder of leaderboard.md and .csv")] = Path("results"),
    runs: Annotated[int | None, typer.Option(help="of each robot")] = None,
    robot: Annotated[
        list[str] | None, typer.Option(help="bundled scenario; repeatable; default one per robot")
    ] = None,
) -> None:
    """Make the reference results again: every bundled robot and its estimators."""
    from estbench.analysis import leaderboard

    began = time.monotonic()
    files = leaderboard.reproduce(
        out, leaderboard.RUNS if runs is None else runs, robot or (), say=say
    )
    print(f"written to {' and '.join(map(str, files))} in {time.monotonic() - began:.0f} s")
