"""Code that a scenario names, and whether it may be run.

A scenario names functions and classes as `module:name`. They are run by everything that builds the
experiment, `check` included. For a scenario of the user's own that is as it should be. A scenario
or a results folder of somebody else may name code of its choice, so that it needs the user's word.
"""

import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from estbench import plugins
from estbench.errors import TRUST, ScenarioError

_KEYS = ("function", "schedule", "type", "base", "estimator")
_TARGET = re.compile(r"([A-Za-z_][\w.]*):[\w./-]+")


def named(data: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """Key and `module:name` of the code in the nested tables of a scenario."""
    if isinstance(data, Mapping):
        for name, value in data.items():
            yield from named(value, f"{key}.{name}".lstrip("."))
    elif isinstance(data, list):
        for i, value in enumerate(data):
            yield from named(value, f"{key}.{i}")
    elif isinstance(data, str) and key.rpartition(".")[2] in _KEYS and _is_code(data):
        yield key, data


def _is_code(text: str) -> bool:
    return bool(_TARGET.fullmatch(text)) and module_of(text) != "estbench"


def module_of(target: str) -> str:
    """The module of `module:name`."""
    return target.partition(":")[0]


def listed(data: Any) -> list[str]:
    """One line for each piece of code that a scenario names, with its file."""
    return [
        f"{key} = {target} ({plugins.location(module_of(target)) or 'not found'})"
        for key, target in named(data)
    ]


def check(found: Mapping[str, str], file: Path) -> None:
    """Refuse code that a scenario of somebody else names, unless the user trusts it.

    Args:
        found: key -> `module:name`, as the file says it and no option changes it.
        file: of the scenario.

    Raises:
        ScenarioError: the file is neither under the current directory nor in an installed package,
            and names code that is neither; and `ESTBENCH_TRUST` is not set.
    """
    if os.environ.get(TRUST, "0") not in ("", "0") or plugins.is_own(file):
        return
    foreign = {
        key: target
        for key, target in found.items()
        if (where := plugins.location(module_of(target))) is None or not plugins.is_own(where)
    }
    if foreign:
        what = ", ".join(f"{key} = {target}" for key, target in foreign.items())
        raise ScenarioError(
            f"{file} names code that would be run: {what}; read it, then allow it by --trust or "
            f"{TRUST}=1"
        )
