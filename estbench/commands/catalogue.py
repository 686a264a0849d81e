"""What `estbench list` prints: scenarios, estimators, controllers and sensor types."""

import importlib
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
            name: scenario.load(path).description for name, path in scenario.bundled().items()
        },
        "estimators": {name: _first_line(target) for name, target in registry.known().items()},
        "controllers": controllers.KINDS,
        "sensor types": {
            name: layout.SENSOR_UNITS.get(name, "") for name in added_sensors.SENSOR_TYPES
        },
    }


def _first_line(target: str) -> str:
    """First line of the docstring of `module:Class`."""
    module, _, name = target.partition(":")
    try:
        doc = getattr(importlib.import_module(module), name).__doc__ or ""
    except (Exception, SystemExit) as error:  # a plug-in that fails must not stop the list
        return f"cannot be imported: {user_error_location(error)}"
    return doc.strip().splitlines()[0] if doc.strip() else ""


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
