"""The command `export`; what it needs is imported when it runs."""

from pathlib import Path
from typing import Annotated

import typer

from estbench.commands.shared import Scenario, console


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    app.command(epilog="Example: estbench export results/pendulum-1 --out logs --run 0")(export)


def export(
    scenario: Scenario,
    out: Annotated[Path, typer.Option(help="folder of the logs; it is made")],
    run: Annotated[
        list[int] | None, typer.Option(help="number of a run; repeatable; default all")
    ] = None,
    form: Annotated[
        str,
        typer.Option("--format", help="csv, mcap (a rosbag2), or tum: poses of free joints"),
    ] = "csv",
) -> None:
    """Write simulated runs as logs that replay reads, with the scenario that maps them."""
    from estbench.logs import export as exporting

    files = exporting.export(scenario, out, run, form)
    beside = "" if form == "tum" else f" and {exporting.SCENARIO}"
    what = "trajectories" if form == "tum" else "logs"
    console().print(f"{len(files)} {what}{beside} written to {out}")
