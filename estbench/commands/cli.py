"""The command line: `estbench run | list | check | control`.

What a command needs is imported when it runs: `--help` answers at once.
"""

import io
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Literal, cast

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from estbench import __version__
from estbench.commands import compare as analysis_commands
from estbench.commands import report as commands
from estbench.errors import EstbenchError, ExecutorError, Interrupted

app = typer.Typer(
    help="Which filter, with which sensors, on this robot, and can I trust its covariance?",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)

_UsageError = cast(type[typer.BadParameter], typer.BadParameter.mro()[1])
"""Base of what typer raises for a bad command line; typer exports no name for it."""

Scenario = Annotated[
    str, typer.Argument(help="bundled name, scenario .toml, MJCF .xml, or a results folder")
]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="SECTION.KEY=VALUE", help="override the scenario; repeatable"),
]


def _version(wanted: bool) -> None:
    if wanted:
        print(f"estbench {__version__}")
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_version, is_eager=True, help="show it and exit"),
    ] = False,
) -> None:
    """What stands before a command."""


@app.command(
    epilog="Example: estbench run cartpole -e ekf -e ukf --runs 500 "
    "--set filter.process_noise_scale=0.01"
)
def run(
    scenario: Scenario,
    estimator: Annotated[
        list[str] | None,
        typer.Option("--estimator", "-e", help="name, label or package.module:Name; repeatable"),
    ] = None,
    runs: Annotated[int | None, typer.Option(help="count of Monte Carlo runs")] = None,
    seed: Annotated[int | None, typer.Option(help="seed of all random numbers")] = None,
    duration: Annotated[float | None, typer.Option(help="length of a run, s")] = None,
    overrides: Overrides = None,
    out: Annotated[
        Path | None, typer.Option(help="results folder; default results/SCENARIO-TIME")
    ] = None,
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
    resume: Annotated[bool, typer.Option(help="go on with --out: compute what is missing")] = False,
    shard: Annotated[
        str | None, typer.Option(metavar="I/N", help="compute the I-th of N shares into one --out")
    ] = None,
    executor: Annotated[
        Literal["auto", "threads", "processes", "dask"],
        typer.Option(
            help="what computes the batches; auto: processes for long work on many CPUs, else "
            "threads"
        ),
    ] = "auto",
    address: Annotated[str | None, typer.Option(help="of the dask scheduler, tcp://...")] = None,
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="threads or processes; default: all CPUs, as memory allows"),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="print JSON in place of tables")] = False,
) -> None:
    """Simulate truth and sensors, run every estimator on them, and say what to think of it."""
    from estbench.montecarlo import run as experiment
    from estbench.store import zarr as store

    resolved = experiment.resolve(scenario, estimator, runs, seed, duration, overrides or ())
    going_on = resume or shard is not None  # with a folder that only the user can name
    folder = out if out is not None or going_on else store.default_folder(resolved.name)
    with _progress(resolved.simulation.runs) as progress:
        results = experiment.run(
            resolved, out=folder, keep=keep, dtype=dtype, resume=resume, shard=_shard(shard),
            executor=executor, address=address, workers=workers, progress=progress,
            say=lambda line: print(f"note: {line}", file=sys.stderr, flush=True),
        )  # fmt: skip
    if as_json:
        print(results.to_json())
    else:
        _console().print(results.render())
    if results.interrupted:
        raise typer.Exit(130)
    if results.failed:  # the notes say which runs are missing, and why
        raise typer.Exit(1)


@app.command("list", epilog="Example: estbench list")
def list_(
    as_json: Annotated[bool, typer.Option("--json", help="print JSON in place of tables")] = False,
) -> None:
    """Show the scenarios, estimators, controllers and sensor types there are."""
    from estbench.commands import check as inspection

    if as_json:
        print(json.dumps(inspection.catalogue(), indent=2))
    else:
        _console().print(inspection.render_catalogue())


@app.command(epilog="Example: estbench check quadrotor")
def check(scenario: Scenario, overrides: Overrides = None) -> None:
    """Load a scenario or MJCF and show its states, sensors, rates, noise and what looks wrong."""
    from estbench.commands import check as inspection
    from estbench.montecarlo import run as experiment

    _console().print(
        inspection.render_check(experiment.resolve(scenario, overrides=overrides or ()))
    )


@app.command(epilog="Example: estbench sensors quadrotor --out sensors.png")
def sensors(
    scenario: Scenario,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="picture to write: .png, .pdf or .svg")
    ] = None,
    seconds: Annotated[float, typer.Option(min=0.0, help="how much of the run to draw")] = 3.0,
    run: Annotated[int, typer.Option(min=0, help="which run to draw")] = 0,
    overrides: Overrides = None,
) -> None:
    """Show what each channel does to the true reading, and draw it."""
    from estbench.experiment import setup
    from estbench.montecarlo import run as experiment
    from estbench.report import sensor_table
    from estbench.report.figures import sensors as sensor_picture

    prepared = setup.build(experiment.resolve(scenario, overrides=overrides or ()))
    if out is not None:
        sensor_picture.write(prepared, out, seconds, run)
    _console().print(sensor_table.render(prepared))
    if out is not None:
        print(f"written to {out}")


@app.command(epilog="Example: estbench control cartpole --controller lqr --runs 100")
def control(
    scenario: Scenario,
    controller: Annotated[
        str | None, typer.Option(help="kind of controller; default the scenario's")
    ] = None,
    estimator: Annotated[
        list[str] | None,
        typer.Option("--estimator", "-e", help="name, label or package.module:Name; repeatable"),
    ] = None,
    runs: Annotated[int, typer.Option(help="count of runs")] = 100,
    seed: Annotated[int | None, typer.Option(help="seed of all random numbers")] = None,
    duration: Annotated[float | None, typer.Option(help="length of a run, s")] = None,
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
        _console().print(control_table.render(compared))


commands.register(app)
analysis_commands.register(app)


def _shard(text: str | None) -> tuple[int, int] | None:
    """`i/n` as a pair of whole numbers."""
    if text is None:
        return None
    parts = text.split("/")
    if len(parts) != 2 or not all(part.isdecimal() for part in parts):
        raise ExecutorError(f"--shard is '{text}'; use I/N, e.g. 1/4")
    return int(parts[0]), int(parts[1])


def _console() -> Console:
    """Colour and full width on a terminal only; 100 columns elsewhere."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=100)


@contextmanager
def _progress(total: int) -> Iterator[Callable[[int, int], None]]:
    """A bar on a terminal, a line every ten seconds elsewhere; both on stderr."""
    if sys.stderr.isatty():
        columns = (
            TextColumn("{task.completed:.0f}/{task.total:.0f} runs"),
            BarColumn(),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task("runs", total=total)
            yield lambda done, total: bar.update(task, completed=done)
        return
    began = last = time.monotonic()

    def line(done: int, total: int) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last >= 10 or (done == total and now - began > 2):
            last = now
            print(f"{done}/{total} runs, {now - began:.0f} s", file=sys.stderr, flush=True)

    yield line


def main() -> None:
    """Entry point: a user's mistake is one line on stderr and exit code 2, never a traceback."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # an ASCII terminal has no σ
    try:
        code = app(prog_name="estbench", standalone_mode=False)
    except EstbenchError as error:
        _complain(str(error))
        sys.exit(130 if isinstance(error, Interrupted) else 2)
    except _UsageError as error:
        # Without any argument typer has printed the help and says nothing more.
        if message := error.format_message():
            help_ = f"; see {error.ctx.command_path} --help" if error.ctx else ""
            _complain(message.rstrip(".") + help_)
        sys.exit(2)
    except (KeyboardInterrupt, typer.Abort):
        sys.exit(130)
    except RuntimeError as error:
        if "MUJOCO_GL" not in str(error):
            raise
        # MuJoCo refuses to be imported.
        chosen = os.environ.get("MUJOCO_GL")
        _complain(f"MUJOCO_GL is {chosen!r}; use egl, osmesa, glfw or disable, or unset it")
        sys.exit(2)
    except BrokenPipeError:
        os._exit(0)  # the reader (head, less) has gone; nothing is left to say
    sys.exit(code)


def _complain(message: str) -> None:
    """One line on stderr."""
    print(f"estbench: {' '.join(message.split())}", file=sys.stderr)
