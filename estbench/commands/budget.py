"""The command `budget`; what it needs is imported when it runs."""

from pathlib import Path
from typing import Annotated

import typer

from estbench.commands.shared import (
    Coordinates,
    Duration,
    Format,
    Overrides,
    Scenario,
    Seed,
    check_plot,
    chosen,
    console,
    progress,
    say,
)


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    app.command(epilog="Example: estbench budget cartpole_bias -e ekf --plot budget.png")(budget)


def budget(
    scenario: Scenario,
    estimator: Annotated[
        str | None,
        typer.Option("--estimator", "-e", help="name, label or package.module:Name; default first"),
    ] = None,
    monte_carlo: Annotated[
        bool, typer.Option("--monte-carlo", help="each source alone, and all but each, by runs")
    ] = False,
    by_source: Annotated[
        bool,
        typer.Option(
            "--by-source", help="each coordinate of the initial error, each process noise"
        ),
    ] = False,
    coordinate: Coordinates = None,
    over_time: Annotated[bool, typer.Option("--over-time", help="a table over time too")] = False,
    runs: Annotated[
        int | None, typer.Option(help="of the Monte Carlo; without it true runs, default 8")
    ] = None,
    seed: Seed = None,
    duration: Duration = None,
    overrides: Overrides = None,
    workers: Annotated[int | None, typer.Option(min=1, help="count of threads")] = None,
    format_: Format = "text",
    plot: Annotated[
        Path | None, typer.Option(help="draw the budget into this .png, .pdf or .svg")
    ] = None,
) -> None:
    """Say which source causes how much of an estimator's error."""
    from estbench.budgets import budget as budgets
    from estbench.budgets import tables
    from estbench.experiment.setup import build
    from estbench.scenario.load import resolve
    from estbench.tables import formats

    formats.check(format_)
    if plot is not None:
        from estbench.report.figures import budgets as figures

        check_plot(plot)
    named = None if estimator is None else [estimator]
    resolved = budgets.one(resolve(scenario, named, runs, seed, duration, overrides or ()))
    setup = build(resolved)
    shown = chosen(coordinate, setup.space.names)
    with progress(resolved.simulation.runs) as bar:
        found = budgets.of_setup(setup, monte_carlo, by_source, runs, workers, bar)
    print(
        formats.render(
            format_, lambda: tables.build(found, shown, over_time),
            lambda: tables.to_csv(found, shown), lambda: tables.to_json(found, shown),
            console().width,
        ).rstrip("\n")
    )  # fmt: skip
    for notice in found.notices:
        say(f"note: {notice}")
    if plot is not None:
        figures.draw(found, plot, shown)
        say(f"drawn in {plot}")
