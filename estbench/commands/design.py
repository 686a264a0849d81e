"""The command `design`; what it needs is imported when it runs."""

from typing import Annotated

import typer

from estbench.commands.shared import (
    Coordinates,
    Duration,
    Format,
    Overrides,
    Scenario,
    Seed,
    chosen,
    console,
    progress,
)


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    app.command(epilog='Example: estbench design quadrotor --require "root.?=0.05"')(design)


def design(
    scenario: Scenario,
    require: Annotated[
        str,
        typer.Option(metavar="COORDINATE=SIGMA,...", help="the largest σ, by pattern"),
    ] = "",
    channels: Annotated[
        str, typer.Option(help="patterns of the candidates, between commas; the others always stay")
    ] = "all",
    estimator: Annotated[
        str | None,
        typer.Option("--estimator", "-e", help="that confirms the suite; default the first"),
    ] = None,
    coordinate: Coordinates = None,
    run: Annotated[int, typer.Option(help="number of the true run along which it is")] = 0,
    runs: Annotated[int, typer.Option(help="that confirm the suite; 0 for none")] = 50,
    seed: Seed = None,
    duration: Duration = None,
    overrides: Overrides = None,
    workers: Annotated[int | None, typer.Option(min=1, help="count of threads")] = None,
    format_: Format = "text",
) -> None:
    """Say what each sensor buys, and find the cheapest suite that is accurate enough."""
    from estbench.suites import bought
    from estbench.suites.design import design as designed
    from estbench.tables import formats

    formats.check(format_)
    with progress(runs) as bar:
        found = designed(
            scenario, require, estimator,
            channels=[part.strip() for part in channels.split(",") if part.strip()],
            run=run, runs=runs, seed=seed, duration=duration, overrides=overrides or (),
            workers=workers, progress=bar,
        )  # fmt: skip
    shown = chosen(coordinate, found.names) if coordinate else bought.required(found)
    print(
        formats.render(
            format_, lambda: bought.build(found, shown), lambda: bought.to_csv(found),
            lambda: bought.to_json(found), console().width,
        ).rstrip("\n")
    )  # fmt: skip
