"""The command `explain`; what it needs is imported when it runs."""

import json
from pathlib import Path
from typing import Annotated

import typer

from estbench.commands.shared import Estimators, Json, console


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    app.command(epilog="Example: estbench explain results/cartpole_bias -e ekf")(explain)


def explain(
    folder: Annotated[Path, typer.Argument(help="results folder")],
    estimator: Estimators = None,
    as_json: Json = False,
) -> None:
    """Say what is wrong with an estimator, where and when, and what usually helps."""
    from estbench.analysis.explanations import explanations, render

    found = explanations(folder, estimator or ())
    if as_json:
        text = {
            e.label: {
                "verdict": e.verdict, "reason": e.reason, "causes": [vars(f) for f in e.findings]
            }
            for e in found
        }  # fmt: skip
        print(json.dumps(text, indent=2, ensure_ascii=False))
    else:
        console().print(render(found))
