"""The commands `compare` and `reproduce`; what they need is imported when they run."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console


def register(app: typer.Typer) -> None:
    """Add the commands to the application."""
    app.command(epilog="Example: estbench compare results/a results/b --format markdown")(compare)


def compare(
    folders: Annotated[list[Path], typer.Argument(help="results folders of one robot")],
    format_: Annotated[
        str, typer.Option("--format", help="text, markdown, csv, latex or json")
    ] = "text",
    margin: Annotated[
        float, typer.Option(help="relative difference that is too small to matter")
    ] = 0.01,
    precision: Annotated[
        float, typer.Option(help="half-width wanted, for the runs that it takes")
    ] = 0.02,
) -> None:
    """Compare estimators run by run: accuracy, ranking with ties, coverage, credibility."""
    from estbench.analysis import formats
    from estbench.analysis.compare import compare_stores

    formats.check(format_)
    found = formats.render(compare_stores(folders, margin, precision), format_)
    if isinstance(found, str):
        print(found.rstrip("\n"))
        return
    console = Console(highlight=False)
    (console if console.is_terminal else Console(highlight=False, width=100)).print(found)
