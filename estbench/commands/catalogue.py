"""What `estbench list` prints: scenarios, estimators, controllers and sensor types."""

import importlib.util
import re
import tomllib
from pathlib import Path
from typing import Any

from rich.console import Group
from rich.table import Table
from rich.text import Text

from estbench.errors import user_error_location
from estbench.estimators import names
from estbench.robots import sensor_types
from estbench.scenario import files
from estbench.simulation import kinds


def catalogue() -> dict[str, dict[str, str]]:
    """Kind -> name -> one line: scenarios, estimators, controllers and sensor types."""
    return {
        "scenarios": {
            name: tomllib.loads(path.read_text(encoding="utf-8"))["description"]
            for name, path in files.bundled().items()
        },
        "estimators": {name: _first_line(target) for name, target in names.known().items()},
        "controllers": kinds.KINDS,
        "sensor types": sensor_types.UNITS,
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
    """First line of a class's docstring in the source of its module; None where it is not there.

    To import all estimators takes a second.
    """
    found = importlib.util.find_spec(module)
    if found is None or not found.origin or not found.origin.endswith(".py"):
        return None
    source = Path(found.origin).read_text(encoding="utf-8")
    line = re.search(rf'^class {re.escape(name)}\b[^:]*:\s+r?"""(.+)', source, re.MULTILINE)
    return line[1].removesuffix('"""') if line else None


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
