"""The command `sensors`; what it needs is imported when it runs."""

from pathlib import Path
from typing import Annotated

import typer

from estbench.commands.shared import Overrides, Scenario, console


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    app.command(epilog="Example: estbench sensors quadrotor --out sensors.png")(sensors)


def sensors(
    scenario: Scenario,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="picture to write: .png, .pdf or .svg")
    ] = None,
    seconds: Annotated[float, typer.Option(min=0.0, help="how much of the run to draw")] = 3.0,
    run: Annotated[int, typer.Option(min=0, help="which run to draw")] = 0,
    overrides: Overrides = None,
) -> None:
    """Show what each channel does to the true reading, and draw it."""
    from estbench.experiment import setup
    from estbench.montecarlo import run as experiment
    from estbench.report import sensor_table
    from estbench.report.figures import sensors as figure

    prepared = setup.build(experiment.resolve(scenario, overrides=overrides or ()))
    if out is not None:
        figure.write(prepared, out, seconds, run)
    console().print(sensor_table.render(prepared))
    if out is not None:
        print(f"written to {out}")
