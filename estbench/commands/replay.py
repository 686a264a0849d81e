"""The command `replay`; what it needs is imported when it runs."""

from pathlib import Path
from typing import Annotated

import typer

from estbench.commands.shared import Estimators, Json, Out, Overrides, console, destination
from estbench.errors import LogError


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    app.command(
        epilog="Example: estbench replay real_pendulum swing_up_1.csv -e ekf --hold-out speed"
    )(replay)


def replay(
    scenario: Annotated[
        str,
        typer.Argument(help="as of run, with a section [log]; with --inspect a log, or a scenario"),
    ],
    logs: Annotated[
        list[Path] | None,
        typer.Argument(help="the files of one log: CSV, TSV, Parquet, npz, or a rosbag"),
    ] = None,
    estimator: Estimators = None,
    hold_out: Annotated[
        list[str] | None,
        typer.Option(help="channel that is predicted and not fused; repeatable"),
    ] = None,
    overrides: Overrides = None,
    out: Out = None,
    inspect: Annotated[
        bool,
        typer.Option(
            "--inspect",
            help="show columns, rates and gaps of logs instead; after a scenario, with a first "
            "[log] for it",
        ),
    ] = False,
    as_json: Json = False,
) -> None:
    """Run estimators on a recorded log, and say what its readings and its truth think of them."""
    from estbench.scenario.load import resolve

    if inspect:
        from estbench.logs import inspect as inspection

        given = resolve(scenario) if logs and not inspection.is_log(Path(scenario)) else None
        files = logs if given and logs else [Path(scenario), *(logs or ())]
        console().print(inspection.render(files, given))
        return
    if not logs:
        raise LogError("no log is named; give the files of one after the scenario")
    from estbench.logs import replay as replaying
    from estbench.logs import results

    resolved = resolve(scenario, estimator, overrides=overrides or ())
    with destination(out, resolved.name) as folder:
        found = replaying.replay(resolved, logs, hold_out=hold_out or (), out=folder)
    if as_json:
        print(results.to_json(found))
    else:
        console().print(results.render(found))
    if any(r.failure for r in found.replayed):
        raise typer.Exit(1)
