"""The commands `list` and `check`; what they need is imported when they run."""

import json

import typer

from estbench.commands.shared import Json, Overrides, Scenario, console


def register(app: typer.Typer) -> None:
    """Add the commands to the application."""
    app.command("list", epilog="Example: estbench list")(list_)
    app.command(epilog="Example: estbench check quadrotor")(check)


def list_(as_json: Json = False) -> None:
    """Show the scenarios, estimators, controllers and sensor types there are."""
    from estbench.commands import catalogue

    if as_json:
        print(json.dumps(catalogue.catalogue(), indent=2))
    else:
        console().print(catalogue.render())


def check(scenario: Scenario, overrides: Overrides = None) -> None:
    """Load a scenario or MJCF and show its states, sensors, rates, noise and what looks wrong."""
    from estbench.scenario.load import resolve

    resolved = resolve(scenario, overrides=overrides or ())  # a typo is named before the rest loads
    from estbench.commands import inspection

    console().print(inspection.render(resolved))
