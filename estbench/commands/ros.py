"""The command `ros`; what it needs is imported when it runs."""

from pathlib import Path
from typing import Annotated

import typer

from estbench.commands.shared import Overrides, Scenario, console


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    app.command(epilog="Example: estbench ros tuned/tuned.toml -e ekf --out ekf.yaml")(ros)


def ros(
    scenario: Scenario,
    estimator: Annotated[
        str | None, typer.Option("--estimator", "-e", help="label; default the scenario's first")
    ] = None,
    overrides: Overrides = None,
    out: Annotated[Path | None, typer.Option(help="the file; default standard output")] = None,
) -> None:
    """Write Q, P₀ and R of a floating base as the YAML that robot_localization reads."""
    from estbench.experiment import robot_localization, setup
    from estbench.scenario.load import resolve
    from estbench.tables.destination import check_file

    if out is not None:
        check_file(out)
    resolved = resolve(scenario, overrides=overrides or ())
    label = estimator or next(iter(resolved.estimators))
    text = robot_localization.parameters(setup.build(resolved), label)
    if out is None:
        print(text, end="")
        return
    out.write_text(text, encoding="utf-8")
    console().print(f"written: {out}")
