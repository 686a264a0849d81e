"""The command `control`; what it needs is imported when it runs."""

import json
from typing import Annotated

import typer

from estbench.commands.shared import Duration, Estimators, Overrides, Scenario, Seed, console


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    app.command(epilog="Example: estbench control cartpole --controller lqr --runs 100")(control)


def control(
    scenario: Scenario,
    controller: Annotated[
        str | None, typer.Option(help="kind of controller; default the scenario's")
    ] = None,
    estimator: Estimators = None,
    runs: Annotated[int, typer.Option(help="count of runs")] = 100,
    seed: Seed = None,
    duration: Duration = None,
    overrides: Overrides = None,
    as_json: Annotated[bool, typer.Option("--json", help="print JSON in place of a table")] = False,
) -> None:
    """Run a controller on the truth, each estimate and raw readings: what the filter costs."""
    from estbench.envs import control as loop
    from estbench.envs import control_table

    compared = loop.compare(
        scenario,
        estimator,
        controller=controller,
        runs=runs,
        seed=seed,
        duration=duration,
        overrides=overrides or (),
    )
    if as_json:
        print(json.dumps(compared.to_dict(), indent=2, allow_nan=False))
    else:
        console().print(control_table.render(compared))
