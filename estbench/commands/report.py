"""The commands `report`, `plot`, `video` and `view`; what they need is imported when they run."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from estbench.commands.shared import Overrides, say

Folders = Annotated[list[Path], typer.Argument(help="results folders of one robot")]
Estimators = Annotated[
    list[str] | None, typer.Option("--estimator", "-e", help="label; repeatable; default all")
]


def register(app: typer.Typer) -> None:
    """Add the commands to the application."""
    app.command(epilog="Example: estbench report results/quadrotor -o quadrotor.html")(report)
    app.command(epilog="Example: estbench plot results/pendulum --what nees --format pdf")(plot)
    app.command(epilog="Example: estbench video quadrotor -e ukf --run 3 -o flight.mp4")(video)
    app.command(epilog="Example: estbench view cartpole -e ekf")(view)


def report(
    folders: Folders,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="default report.html in the first folder")
    ] = None,
    estimator: Estimators = None,
    video: Annotated[
        bool, typer.Option(help="embed the best and the worst run, if this machine can draw")
    ] = True,
    budget: Annotated[
        bool, typer.Option("--budget", help="the error budget of each estimator too, some seconds")
    ] = False,
) -> None:
    """Write one HTML file with all tables and figures; it opens offline."""
    from estbench.report.html import write_report

    path = write_report(folders, out, estimator or (), video, say, budget)
    print(f"written to {path} ({path.stat().st_size / 1e6:.1f} MB)")


def plot(
    folders: Folders,
    what: Annotated[
        str,
        typer.Option(
            help="nees, nis, error, rmse, coverage, histogram, autocorrelation, touch-down or "
            "innovation"
        ),
    ] = "nees",
    format_: Annotated[str, typer.Option("--format", help="png, pdf or svg")] = "pdf",
    columns: Annotated[int, typer.Option(min=1, max=2, help="width on the page")] = 1,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="default WHAT.FORMAT in the first folder")
    ] = None,
    estimator: Estimators = None,
    run: Annotated[
        int | None, typer.Option(help="error, innovation: which run; default the worst")
    ] = None,
    coordinate: Annotated[
        list[str] | None, typer.Option(help="error, rmse, coverage: repeatable; default all")
    ] = None,
) -> None:
    """Draw one of the report's figures for a paper."""
    from estbench.report.figures import plots
    from estbench.report.sources import load
    from estbench.tables.destination import check_file

    if out is not None:
        check_file(out)
    path = out if out is not None else folders[0] / f"{what}.{format_}"
    paper = plots.Paper(load(folders, estimator or ()), columns, run, coordinate or ())
    plots.plot(paper, what, path)
    print(f"written to {path}")


def video(
    source: Annotated[str, typer.Argument(help="results folder or scenario")],
    run: Annotated[int, typer.Option(help="number of the run")] = 0,
    estimator: Annotated[
        str | None, typer.Option("--estimator", "-e", help="label; default the first")
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help=".mp4, .gif, or .png with --at")] = Path(
        "video.mp4"
    ),
    at: Annotated[float | None, typer.Option(help="s; one frame as .png")] = None,
    width: Annotated[int, typer.Option(help="pixels")] = 640,
    height: Annotated[int, typer.Option(help="pixels of the robot's picture")] = 480,
    fps: Annotated[float, typer.Option(help="frames per second")] = 25.0,
    speed: Annotated[float, typer.Option(help="2 plays twice as fast")] = 1.0,
    camera: Annotated[str | None, typer.Option(help="a camera of the model")] = None,
    overrides: Overrides = None,
) -> None:
    """Film one run: the truth, the estimate as a ghost, its covariance, and a chart of NEES.

    Of a replay without truth the estimate alone, and a chart of NIS.
    """
    from estbench.report.rendering import replay
    from estbench.report.rendering import video as film

    look = film.Look(width, height, fps, speed, camera)
    film.check(out, at)
    shown = replay.replay(source, run, estimator, overrides or ())
    count = film.write(shown, out, look, at, _progress())
    if not shown.correlated:
        say("estbench: the ellipsoid is from variances alone (--keep full)")
    print(f"written to {out} ({count} frame{'s' if count > 1 else ''})")


def view(
    scenario: Annotated[str, typer.Argument(help="bundled name, scenario .toml or MJCF .xml")],
    estimator: Annotated[
        str | None, typer.Option("--estimator", "-e", help="label; default the first")
    ] = None,
    run: Annotated[int, typer.Option(help="number of the first run")] = 0,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="of the page; 0 takes the first free from 8080")
    ] = 0,
    window: Annotated[
        bool, typer.Option("--window", help="a window of this desktop in place of the browser")
    ] = False,
    overrides: Overrides = None,
) -> None:
    """Watch truth and estimate live, in a browser; keys change noise and Q."""
    from estbench.report.rendering.view import watch

    watch(scenario, estimator, run, port=port, window=window, overrides=overrides or ())


def _progress() -> Callable[[int, int], None]:
    """A function that prints the finished and all frames every five seconds, on standard error."""
    last = time.monotonic()

    def line(done: int, total: int) -> None:
        nonlocal last
        if time.monotonic() - last > 5:
            last = time.monotonic()
            say(f"{done}/{total} frames")

    return line
