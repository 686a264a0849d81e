"""What `estbench list` prints: scenarios, estimators, controllers and sensor types."""

import ast
import importlib.util
import tomllib
from pathlib import Path
from typing import Any

from rich.console import Group
from rich.table import Table
from rich.text import Text

from estbench.errors import user_error_location
from estbench.estimators import registry
from estbench.robots import added_sensors, layout
from estbench.scenario import load as scenario
from estbench.simulation import controllers


def catalogue() -> dict[str, dict[str, str]]:
    """Kind -> name -> one line: scenarios, estimators, controllers and sensor types."""
    return {
        "scenarios": {
            name: tomllib.loads(path.read_text(encoding="utf-8"))["description"]
            for name, path in scenario.bundled().items()
        },
        "estimators": {name: _first_line(target) for name, target in registry.known().items()},
        "controllers": controllers.KINDS,
        "sensor types": {
            name: layout.SENSOR_UNITS.get(name, "") for name in added_sensors.SENSOR_TYPES
        },
    }


def _first_line(target: str) -> str:
    """First line of the docstring of `module:Class`, read from the source where it stands there."""
    module, _, name = target.partition(":")
    try:
        doc = _written(module, name)
        if doc is None:
            doc = getattr(importlib.import_module(module), name).__doc__ or ""
    except (Exception, SystemExit) as error:  # a plug-in that fails must not stop the list
        return f"cannot be imported: {user_error_location(error)}"
    return doc.strip().splitlines()[0] if doc.strip() else ""


def _written(module: str, name: str) -> str | None:
    """The docstring of a class in the source of its module; None where it is not there.

    To import all estimators takes a second.
    """
    found = importlib.util.find_spec(module)
    if found is None or not found.origin or not found.origin.endswith(".py"):
        return None
    body = ast.parse(Path(found.origin).read_bytes()).body
    classes = [node for node in body if isinstance(node, ast.ClassDef) and node.name == name]
    return ast.get_docstring(classes[-1]) if classes else None


def render() -> Group:
    """The catalogue for a rich console."""
    parts: list[Any] = []
    for heading, entries in catalogue().items():
        if heading == "sensor types":
            parts.append(Text(f"\n{heading} (any MuJoCo sensor)", style="bold"))
            parts.append(Text(", ".join(entries)))
            continue
        table = Table(title=f"\n{heading}", title_justify="left", title_style="bold", box=None,
                      show_header=False)  # fmt: skip
        table.add_column(no_wrap=True)
        table.add_column()
        for name, line in entries.items():
            table.add_row(name, line)
        parts.append(table)
    return Group(*parts)
