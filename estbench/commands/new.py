"""The commands `new` and `schema`; what they need is imported when they run."""

from pathlib import Path
from typing import Annotated

import typer

from estbench.commands.shared import console

Mjcf = Annotated[str, typer.Argument(help="MJCF .xml, or package:path/in/package")]


def register(app: typer.Typer) -> None:
    """Add the commands to the application."""
    app.command(epilog="Example: estbench new my_robot.xml --sensors imu,encoders")(new)
    app.command(epilog="Example: estbench schema --out scenario.schema.json")(schema)


def new(
    mjcf: Mjcf,
    out: Annotated[
        Path | None, typer.Option(help="the file; default scenario.toml beside the MJCF")
    ] = None,
    sensors: Annotated[
        str | None,
        typer.Option(help="those added and on: encoders, position, imu; default those needed"),
    ] = None,
) -> None:
    """Write a commented scenario for a robot: sensors, noise and a controller that moves it."""
    from estbench.starter.create import create
    from estbench.starter.sensors import asked

    written = create(mjcf, out, asked(sensors))
    console().print(f"written: {written}\nnext: estbench check {written}; estbench run {written}")


def schema(
    out: Annotated[Path | None, typer.Option(help="the file; default standard output")] = None,
) -> None:
    """Write the JSON Schema of a scenario, with which editors complete and check the file."""
    from estbench.scenario.json_schema import json_schema
    from estbench.tables.destination import check_file

    if out is None:
        print(json_schema(), end="")
        return
    check_file(out)
    out.write_text(json_schema(), encoding="utf-8")
    console().print(f"written: {out}")
