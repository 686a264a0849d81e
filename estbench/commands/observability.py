"""The command `observability`; what it needs is imported when it runs."""

from typing import Annotated

import typer

from estbench.commands.shared import Format, Overrides, Scenario, Seed, console


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    app.command(epilog="Example: estbench observability quadrotor --window 2")(observability)


def observability(
    scenario: Scenario,
    window: Annotated[
        float | None, typer.Option(help="s from the start; default the whole run")
    ] = None,
    run: Annotated[int, typer.Option(help="number of the run whose motion it is")] = 0,
    motions: Annotated[
        bool, typer.Option(" /--no-motions", help="try no motions that would show what is hidden")
    ] = True,
    seed: Seed = None,
    overrides: Overrides = None,
    format_: Format = "text",
) -> None:
    """Say what the sensors see along the truth's motion, from when on, and what they never see."""
    from estbench.suites import seen
    from estbench.suites.observability import observability as observed
    from estbench.tables import formats

    formats.check(format_)
    found = observed(
        scenario, window=window, run=run, motions=motions, seed=seed, overrides=overrides or ()
    )
    print(
        formats.render(
            format_, lambda: seen.build(found), lambda: seen.to_csv(found),
            lambda: seen.to_json(found), console().width,
        ).rstrip("\n")
    )  # fmt: skip
