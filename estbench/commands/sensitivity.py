"""The command `sensitivity`; what it needs is imported when it runs."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from estbench.commands.shared import (
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
    app.command(
        epilog="Example: estbench sensitivity cartpole -e ekf --runs 50 --plot tornado.png"
    )(sensitivity)


def sensitivity(
    scenario: Scenario,
    estimator: Annotated[
        str | None,
        typer.Option("--estimator", "-e", help="name, label or package.module:Name; default first"),
    ] = None,
    key: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PATTERN",
            help="parameters, e.g. 'filter.*'; KEY=log:LOW:HIGH or KEY=lin:LOW:HIGH gives a range "
            "for --sobol; repeatable; default all",
        ),
    ] = None,
    by_source: Annotated[
        bool,
        typer.Option("--by-source", help="each coordinate of P₀, each process noise"),
    ] = False,
    step: Annotated[float, typer.Option(help="relative change of each parameter")] = 0.1,
    curves: Annotated[
        int | None,
        typer.Option(help="parameters with a curve over 1/4 to 4 times their value; with --plot 3"),
    ] = None,
    ranges: Annotated[
        bool,
        typer.Option(
            "--ranges",
            help="where the verdict stays consistent; without --key of what the filter believes",
        ),
    ] = False,
    sobol: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Sobol indices from N (d + 2) scenarios, N a power of two; without "
            "--key of the six largest",
        ),
    ] = None,
    spread: Annotated[
        float, typer.Option(help="factor below and above each value, for --sobol")
    ] = 2.0,
    coordinate: Annotated[
        list[str] | None,
        typer.Option(
            "--coordinate", metavar="PATTERN", help="those with a column; repeatable; default none"
        ),
    ] = None,
    runs: Annotated[int | None, typer.Option(help="Monte Carlo runs of each variant")] = None,
    seed: Seed = None,
    duration: Duration = None,
    overrides: Overrides = None,
    workers: Annotated[int | None, typer.Option(min=1, help="count of threads")] = None,
    format_: Format = "text",
    plot: Annotated[
        Path | None,
        typer.Option("--plot", "--figure", help="draw it into this .png, .pdf or .svg"),
    ] = None,
) -> None:
    """Say how much each number of the filter and of the hardware matters."""
    from estbench.budgets.budget import one
    from estbench.errors import StudyError
    from estbench.experiment.setup import build
    from estbench.scenario.load import resolve
    from estbench.sensitivities import sensitivity as analysis
    from estbench.sensitivities import tables
    from estbench.tables import formats

    formats.check(format_)
    if plot is not None:
        from estbench.report.figures import sensitivities as figures

        check_plot(plot)
    named = None if estimator is None else [estimator]
    resolved = one(resolve(scenario, named, runs, seed, duration, overrides or ()))
    names = build(resolved).space.names
    csv = chosen(coordinate, names)
    shown = csv if coordinate else []
    wanted = (3 if plot is not None else 0) if curves is None else curves
    with progress(resolved.simulation.runs) as bar:
        found = analysis.of_scenario(
            resolved, key=key or (), by_source=by_source, step=step, curves=wanted, ranges=ranges,
            sobol=sobol, spread=spread, workers=workers, progress=bar,
        )  # fmt: skip
    if not found.slopes and found.indices is None:
        raise StudyError("no parameter can be varied; see the notes, or name one with --key")
    asked = found if curves else replace(found, curves=())  # those of --plot are not printed
    print(
        formats.render(
            format_, lambda: tables.build(asked, shown), lambda: tables.to_csv(found, csv),
            lambda: tables.to_json(found), console().width,
        ).rstrip("\n")
    )  # fmt: skip
    for notice in found.notices:
        say(f"note: {notice}")
    if plot is not None:
        figures.draw(found, plot)
        say(f"drawn in {plot}")
