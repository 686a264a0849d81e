"""The command `tune`; what it needs is imported when it runs."""

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import typer

from estbench.commands.shared import (
    Duration,
    Json,
    Overrides,
    Scenario,
    Seed,
    check_plot,
    console,
    destination,
    say,
)
from estbench.errors import StudyError


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    app.command(
        epilog="Example: estbench tune cartpole -e ekf --free filter.process_noise_scale "
        "--free filter.measurement_noise_scale --runs 100"
    )(tune)


def tune(
    scenario: Scenario,
    estimator: Annotated[
        str, typer.Option("--estimator", "-e", help="name, label or package.module:Name")
    ],
    free: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY[=LOW:HIGH]",
            help="what is fitted: a key under filter or start, or a setting of the estimator; "
            "KEY=A,B,C chooses between values; repeatable",
        ),
    ] = None,
    objective: Annotated[
        Literal["likelihood", "mse", "consistent-mse"],
        typer.Option(help="likelihood of the readings; squared error; this with NEES/n near 1"),
    ] = "likelihood",
    coordinate: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME[=WEIGHT]", help="whose squared error counts; repeatable; default all"
        ),
    ] = None,
    prior: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY=CENTRE:SPREAD", help="median and factor known beforehand; repeatable"
        ),
    ] = None,
    method: Annotated[
        Literal["auto", "quasi-newton", "nelder-mead", "evolution", "optuna"],
        typer.Option(help="of the search; auto fits it to what is free"),
    ] = "auto",
    iterations: Annotated[
        int, typer.Option(min=1, help="most iterations, or candidates of nelder-mead and optuna")
    ] = 60,
    runs: Annotated[int | None, typer.Option(help="count of tuning runs")] = None,
    held_out: Annotated[
        int | None, typer.Option(min=0, help="runs that prove the result; default as many")
    ] = None,
    log: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE[,FILE]",
            help="recorded log to tune on instead of simulated runs; repeatable",
        ),
    ] = None,
    held_out_log: Annotated[
        list[Path] | None,
        typer.Option(metavar="FILE[,FILE]", help="log that proves the result; repeatable"),
    ] = None,
    hold_out: Annotated[
        list[str] | None,
        typer.Option(help="channel of the logs that is predicted and not fused; repeatable"),
    ] = None,
    seed: Seed = None,
    duration: Duration = None,
    overrides: Overrides = None,
    out: Annotated[
        Path | None, typer.Option(help="folder of tuned.toml; default results/SCENARIO-tuned-TIME")
    ] = None,
    resume: Annotated[bool, typer.Option(help="go on with --out")] = False,
    workers: Annotated[int | None, typer.Option(min=1, help="count of threads")] = None,
    plot: Annotated[
        Path | None, typer.Option(help="draw profiles and trace into this .png, .pdf or .svg")
    ] = None,
    as_json: Json = False,
) -> None:
    """Fit what an estimator believes to the readings, and prove it on runs it has not seen."""
    from estbench.scenario.load import resolve
    from estbench.tuning import parameters
    from estbench.tuning import tune as tuning

    if plot is not None:
        from estbench.report.figures import tuning as figures

        check_plot(plot)
    resolved = resolve(scenario, [estimator], runs, seed, duration, overrides or ())
    given = {"runs": runs, "duration": duration} if log else {}  # refused there
    priors = dict(parameters.parse_prior(text) for text in prior or ())
    with destination(out, f"{resolved.name}-tuned", resume) as folder:
        tuned = tuning.tune(
            resolved, next(iter(resolved.estimators)), free or (), objective=objective,
            coordinates=dict(map(_weight, coordinate or ())),
            priors={key: (p.centre, p.spread) for key, p in priors.items()}, method=method,
            iterations=iterations, held_out=held_out, **given, logs=list(map(_files, log or ())),
            held_out_logs=list(map(_files, held_out_log or ())), hold_out=hold_out or (),
            out=folder, resume=resume, workers=workers, progress=_progress(),
        )  # fmt: skip
    if as_json:
        print(tuned.to_json())
    else:
        console().print(tuned.render())
    if plot is not None:
        figures.draw(tuned, plot)
        say(f"drawn in {plot}")
    if tuned.interrupted:
        say(f"go on with --out {folder} --resume")
        raise typer.Exit(130)


def _files(text: Path) -> list[str]:
    """The files of one log."""
    return str(text).split(",")


def _weight(text: str) -> tuple[str, float]:
    """`NAME` or `NAME=WEIGHT`.

    Raises:
        StudyError: the weight is no positive number.
    """
    name, equals, weight = text.partition("=")
    try:
        value = float(weight) if equals else 1.0
    except ValueError:
        value = 0.0
    if not value > 0:
        raise StudyError(f"--coordinate {text!r}: the weight is not above 0; use NAME=WEIGHT")
    return name, value


def _progress() -> Callable[[int, float], None]:
    """Shows candidates and the least loss: on a terminal in one line, else every ten seconds."""
    last = time.monotonic()

    def line(candidates: int, loss: float) -> None:
        nonlocal last
        text = f"{candidates} candidates, least loss {loss:.6g}"
        if sys.stderr.isatty():
            print(f"\r{text}\x1b[K", end="", file=sys.stderr, flush=True)
        elif time.monotonic() - last > 10:
            last = time.monotonic()
            say(text)

    return line
