"""The command `run`; what it needs is imported when it runs."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from estbench.commands.shared import (
    Address,
    Duration,
    Estimators,
    Json,
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
    say,
    shares,
)
from estbench.errors import LogError


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    app.command(
        epilog="Example: estbench run cartpole -e ekf -e ukf --runs 500 "
        "--set filter.process_noise_scale=0.01"
    )(run)


def run(
    scenario: Scenario,
    estimator: Estimators = None,
    runs: Annotated[int | None, typer.Option(help="count of Monte Carlo runs")] = None,
    seed: Seed = None,
    duration: Duration = None,
    overrides: Overrides = None,
    out: Out = None,
    keep: Annotated[
        Literal["auto", "summary", "diagonal", "full"],
        typer.Option(
            help="what is stored of every run: averages; + traces; + covariances and innovations; "
            "auto: traces while they take less than 1 GiB"
        ),
    ] = "auto",
    dtype: Annotated[
        Literal["float64", "float32"] | None,
        typer.Option(help="of the stored traces; default float64"),
    ] = None,
    precision: Annotated[
        float | None,
        typer.Option(
            help="add runs, up to --runs (give a large one), until NEES/n is known to ± this"
        ),
    ] = None,
    precision_of: Annotated[
        str | None,
        typer.Option(
            metavar="A,B",
            help="with --precision: until the ratio of the RMSE of two estimators is, 0.02 = 2%",
        ),
    ] = None,
    until_decided: Annotated[
        bool,
        typer.Option(
            "--until-decided", help="add runs, up to --runs, until no verdict is undecided"
        ),
    ] = False,
    resume: Resume = False,
    shard: Shard = None,
    executor: Annotated[
        Literal["auto", "threads", "processes", "dask"],
        typer.Option(
            help="what computes the batches; auto: processes for long work on many CPUs, else "
            "threads"
        ),
    ] = "auto",
    address: Address = None,
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="threads or processes; default: all CPUs, as memory allows"),
    ] = None,
    bound: Annotated[
        bool,
        typer.Option(
            " /--no-bound",
            show_default=False,
            help="leave out the bound on the errors, and with it the efficiency",
        ),
    ] = True,
    like: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE[,FILE]",
            help="simulate under the controls and at the times of a recorded log, with the noise "
            "that the filter believes, and lay the innovations of both side by side",
        ),
    ] = None,
    hold_out: Annotated[
        list[str] | None,
        typer.Option(help="with --like: channel that is not fused; repeatable"),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(help="with --like: draw the spectra into this .png, .pdf or .svg"),
    ] = None,
    as_json: Json = False,
) -> None:
    """Simulate truth and sensors, run every estimator on them, and say what to think of it."""
    if like is not None:
        _like(scenario, like, estimator, runs, seed, overrides, hold_out, plot, as_json)
        return
    if hold_out or plot is not None:
        option = "--hold-out" if hold_out else "--plot"
        raise LogError(f"{option} needs --like LOG; without it see replay, plot and report")
    from estbench.scenario.load import resolve

    changes = [*(overrides or ()), *(() if bound else ("bound=false",))]
    resolved = resolve(scenario, estimator, runs, seed, duration, changes)
    from estbench.montecarlo import run as experiment  # two seconds: a typo is named before

    place = destination(out, resolved.name, resume or shard is not None)
    ends = precision is None and not until_decided
    with place as folder, progress(resolved.simulation.runs, ends) as bar:
        results = experiment.run(
            resolved, out=folder, keep=keep, dtype=dtype, precision=precision,
            precision_of=pair(precision_of),
            until_decided=until_decided, resume=resume, shard=shares(shard), executor=executor,
            address=address, workers=workers, progress=bar,
            say=lambda line: say(f"note: {line}"),
        )  # fmt: skip
    if as_json:
        print(results.to_json())
    else:
        console().print(results.render())
    if results.interrupted:
        raise typer.Exit(130)
    if results.failed:  # the notes name the missing runs and the cause
        raise typer.Exit(1)


def pair(text: str | None) -> tuple[str, str] | None:
    """`A,B` as a pair of labels; what is no pair is refused with the other mistakes of a rule."""
    return None if text is None else tuple(text.split(","))  # type: ignore[return-value]


def _like(
    scenario: str,
    log: Path,
    estimators: list[str] | None,
    runs: int | None,
    seed: int | None,
    overrides: list[str] | None,
    hold_out: list[str] | None,
    plot: Path | None,
    as_json: bool,
) -> None:
    """`--like`: runs like a log, compared with it; nothing is stored."""
    from estbench.logs import likeness, likeness_results

    if plot is not None:
        from estbench.report.figures import likeness as figures

        check_plot(plot)
    changes = [*(overrides or ()), *(() if seed is None else (f"simulation.seed={seed}",))]
    found = likeness.like(
        scenario, str(log).split(","), estimators, hold_out=hold_out or (),
        runs=likeness.RUNS if runs is None else runs, overrides=changes,
    )  # fmt: skip
    if as_json:
        print(likeness_results.to_json(found))
    else:
        console().print(likeness_results.render(found))
    if plot is not None:
        figures.draw(found, plot)
        say(f"drawn in {plot}")
