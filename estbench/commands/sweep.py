"""The command `sweep`; what it needs is imported when it runs."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from estbench.commands.shared import (
    Address,
    Duration,
    Estimators,
    Out,
    Overrides,
    Resume,
    Scenario,
    Seed,
    Shard,
    check_plot,
    console,
    destination,
    progress,
    shares,
)
from estbench.errors import StudyError
from estbench.tables.names import visible


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    app.command(
        epilog="Example: estbench sweep cartpole -e ekf --over "
        "filter.process_noise_scale=log:0.01:100:9 --plot sweep.png"
    )(sweep)


def sweep(
    scenario: Scenario,
    over: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY=SPEC",
            help="a key to vary; SPEC: a list 0.1,1,10, lin:LOW:HIGH:COUNT or log:LOW:HIGH:COUNT; "
            "repeatable",
        ),
    ] = None,
    estimator: Estimators = None,
    sample: Annotated[
        Literal["sobol", "latin"] | None,
        typer.Option(help="points spread over the ranges, in place of a grid"),
    ] = None,
    points: Annotated[int, typer.Option(help="count of these points")] = 32,
    runs: Annotated[int | None, typer.Option(help="Monte Carlo runs of each variant")] = None,
    seed: Seed = None,
    duration: Duration = None,
    overrides: Overrides = None,
    out: Out = None,
    resume: Resume = False,
    shard: Shard = None,
    executor: Annotated[
        Literal["auto", "threads", "processes", "dask"],
        typer.Option(help="what computes the batches; see `estbench run --help`"),
    ] = "auto",
    address: Address = None,
    workers: Annotated[int | None, typer.Option(min=1, help="threads or processes")] = None,
    plot: Annotated[
        Path | None, typer.Option(help="draw the sweep into this .png, .pdf or .svg")
    ] = None,
    what: Annotated[
        list[str] | None,
        typer.Option(help="statistic to draw; repeatable; default anees_over_n and rmse"),
    ] = None,
) -> None:
    """Run the estimators for every combination of the values of some keys."""
    from estbench.scenario.load import resolve
    from estbench.study import run as running
    from estbench.study import sweep as sweeping

    if plot is not None:
        from estbench.report.figures import sweeps

        check_plot(plot)
    if not over:
        raise StudyError("no key is varied; name one with --over KEY=SPEC")
    resolved = resolve(scenario, estimator, runs, seed, duration, overrides or ())
    study = sweeping.design(resolved, over, sample, points)
    if plot is not None:
        sweeps.check(study, what or sweeps.DEFAULT)
    place = destination(out, resolved.name, resume or shard is not None)
    with place as folder, progress(len(study.variants) * resolved.simulation.runs) as bar:
        found = running.run(
            study, out=folder, resume=resume, shard=shares(shard), executor=executor,
            address=address, workers=workers, progress=bar,
        )  # fmt: skip
    shown = console()
    table = sweeping.table(found)
    title = (
        f"{visible(resolved.name)}: {len(study.variants)} variants x {len(found.runs)} runs x "
        f"{found.times[0][-1]:g} s, seed {resolved.simulation.seed}; "
        f"truth simulated for {len(study.groups)} of them"
    )
    shown.print(title, style="bold", markup=False)
    for notice in found.notices:
        shown.print(visible(f"note: {notice}"), style="dim", markup=False)
    shown.print(table)
    shown.print(table.note, style="dim")
    for (variant, label), reason in list(found.failures.items())[:5]:
        shown.print(visible(f"variant {variant}, {label}: {reason}"), style="red", markup=False)
    if folder is not None:
        shown.print(f"written to {folder}")
    if plot is not None:
        sweeps.draw(study, found.dataset(), plot, what or sweeps.DEFAULT)
        shown.print(f"drawn in {plot}")
    if found.interrupted:
        shown.print(f"go on with --out {folder} --resume")
        raise typer.Exit(130)
