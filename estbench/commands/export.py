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
) -> None:
    """Write simulated runs as CSV logs that replay reads, with the scenario that maps them."""
    from estbench.logs import export as exporting

    files = exporting.export(scenario, out, run)
    console().print(f"{len(files)} logs and {exporting.SCENARIO} written to {out}")
