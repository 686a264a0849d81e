"""Scenarios with one to three values that do not belong where they stand."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import numpy as np
import tomli_w

import estbench
from benchmarks.fuzz.case import Case
from estbench.scenario.load import load
from estbench.scenario.schema import Scenario, Section

ROBOTS = {
    "pendulum": ("encoder", "hinge"), "cartpole": ("encoder", "pole"), "quadrotor": ("gyro", "x"),
}  # fmt: skip
"""Scenario -> names that take the place of a channel or a parameter."""
WILD: tuple[Any, ...] = (
    1e-300, 1e300, 1e-200, 1e16, -1e16, float("nan"), float("inf"), -float("inf"), -1, -1e-3, True,
    "1", "", "x", "a:b", "os:getcwd", "\x1b[31m", "../../x", [], {}, [[]], [float("nan")],
    [1e308] * 3, {"*": "x"}, {"": 1}, {"x": {"y": 1}}, 10**12, 10**18, 2**63, [1, "a"],
    [[1, 2], [3]],
)  # fmt: skip
"""Values that no key takes; some are texts or counts that a key may take."""
ODD: tuple[Any, ...] = (0, 1, 2, 0.5, 1e-12, 1e-6, 1e6, 1e12, [0.1], {"*": 0.1}, "linear", 1000)
"""Values that a key may take or not."""
ESTIMATORS = (
    "ekf", "ukf", "kf", "ckf", "iekf", "sr_ekf", "sr_ukf", "enkf", "pf", "ghkf", "imm",
    "robust_ekf", "adaptive_ekf", "schmidt_ekf", "rts", "map", "iplf", "diplf", "rotated_ukf",
    "cd_ekf", "lkf",
)  # fmt: skip
SETTINGS = ("size", "order", "alpha", "kappa", "iterations", "window", "substeps", "start",
            "filter", "delays", "tolerance", "type", "gate", "nonsense")  # fmt: skip


def keys(
    section: type[Section] = Scenario, path: tuple[str, ...] = ()
) -> Iterator[tuple[str, ...]]:
    """Every key of a section and of the sections in it; a table of sections has the entry `*`."""
    for name, field in section.model_fields.items():
        yield (*path, name)
        options = [field.annotation, *get_args(field.annotation)]
        table = any(str(getattr(o, "__origin__", "")) == "<class 'dict'>" for o in options)
        inner = [*options, *(arg for o in options for arg in get_args(o))]
        for option in inner:
            if isinstance(option, type) and issubclass(option, Section):
                yield from keys(option, (*path, name, *(("*",) if table else ())))


def cases(count: int, seed: int) -> Iterator[Case]:
    """Mutated scenarios."""
    known = sorted(set(keys()))
    for i in range(count):
        rng = np.random.default_rng((seed, 1, i))
        robot = str(rng.choice(list(ROBOTS)))
        data = load(robot).model_dump(mode="json", exclude_none=True)
        data["simulation"] |= {"runs": 2, "duration": 0.05}
        data["estimators"] = {str(name): {} for name in rng.choice(ESTIMATORS, 1)}
        said, wild = [], False
        for _ in range(int(rng.integers(1, 4))):
            if rng.random() < 0.2:
                label = next(iter(data["estimators"]))
                path = ("estimators", label, str(rng.choice(SETTINGS)))
            else:
                names = ROBOTS[robot]
                path = tuple(
                    str(rng.choice(names)) if part == "*" else part
                    for part in known[rng.integers(len(known))]
                )
            bad = bool(rng.random() < 0.7)
            value = (WILD if bad else ODD)[rng.integers(len(WILD if bad else ODD))]
            if _assign(data, path, value):
                said.append(f"{'.'.join(path)}={value!r}")
                wild |= bad and isinstance(value, float)
        yield Case(f"{robot}: {', '.join(said)}", _Run(data), wild)


class _Run:
    def __init__(self, data: dict[str, Any]):
        self._data = data

    def __call__(self, folder: Path) -> str:
        path = folder / "scenario.toml"
        path.write_text(tomli_w.dumps(self._data), encoding="utf-8")
        results = estbench.run(path)
        str(results)
        results.to_json()
        return ", ".join(f"{s.label}: {s.verdict}" for s in results.summaries)


def _assign(data: dict[str, Any], path: tuple[str, ...], value: Any) -> bool:
    table = data
    for part in path[:-1]:
        table = table.setdefault(part, {})
        if not isinstance(table, dict):
            return False
    table[path[-1]] = value
    return True
