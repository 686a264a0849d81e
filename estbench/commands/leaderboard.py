"""The command `leaderboard`; what it needs is imported when it runs."""

from pathlib import Path
from typing import Annotated

import typer

from estbench.commands.shared import console, say


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    app.command(epilog="Example: estbench leaderboard my_package --out entries.csv")(leaderboard)


def leaderboard(
    package: Annotated[
        str, typer.Argument(help="installed package with entry points, or module:Name")
    ],
    out: Annotated[Path, typer.Option(help="CSV file to which the rows are appended")] = Path(
        "entries.csv"
    ),
    runs: Annotated[int | None, typer.Option(help="of each robot; default 60, large ones 10")] = (
        None
    ),
    robot: Annotated[
        list[str] | None, typer.Option(help="bundled scenario; repeatable; default one per robot")
    ] = None,
    logs: Annotated[
        Path | None, typer.Option(help="folder of the recorded logs, by scenario")
    ] = None,
) -> None:
    """Run an estimator of a package on the reference scenarios and append its rows."""
    from estbench.analysis import entries

    rows = entries.enter(package, out, runs, robot or (), logs, say=say)
    table = entries.table(rows)
    console().print(table)
    for row in rows:
        if not row.get("verdict"):
            say(f"{entries.place(row)}: not run: {row['note']}")
    console().print(f"{len(rows)} rows appended to {out}; table in {out.with_suffix('.md')}")
