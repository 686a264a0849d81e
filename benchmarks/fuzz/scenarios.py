"""Scenarios with one to three strange values.

In every second scenario a value is one that its key takes by itself, so that the scenario passes
the schema and the values meet further inside; in the others it is any.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import numpy as np
import tomli_w
from pydantic import ValidationError, create_model
from pydantic.fields import FieldInfo

import estbench
from benchmarks.fuzz.case import Case
from estbench.scenario.load import load
from estbench.scenario.quantities import Section
from estbench.scenario.schema import Scenario

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
ODD: tuple[Any, ...] = (
    0,
    1,
    2,
    0.5,
    1e-12,
    1e-6,
    1e6,
    1e12,
    [0.1],
    {"*": 0.1},
    "linear",
    1000,
    0.0,
    1.0,
    1e-15,
    1e15,
    1e-7,
    1e-3,
    3.0,
    30.0,
    1e9,
    -1.0,
    0.999,
    2**31 - 1,
    7,
    False,
    [0],
    [1, 0],
    [0.1, 0.2],
    [-1.0],
    [1e15],
    {"*": 0.0},
    {"*": 1e15},
    {"*": -1.0},
    {"*": [0.1]},
    [[1.0]],
    [[-1.0]],
    [[0.0]],
    [[1.0, 0.0], [0.0, 1.0]],
    [[0.01, 2.0]],
    [[0.01, 2.0], [0.005, 1.0]],
    [[1e9, 1e15]],
    ["encoder"],
    ["encoder", "encoder"],
    "encoder",
    "hinge",
    "math:sin",
    "ekf",
    "reference",
    {"hinge": 1.0},
    {"body_mass.*": 1e9},
    {"body_mass.1": 0.0},
    {"opt.timestep": 1.0},
    {"dof_damping.*": -1.0},
    {"body_mass.1": {"std": 1e9}},
    {"type": "gyro", "object": "*"},
    {"type": "jointpos", "object": 0},
    {"type": "clock"},
    {"type": "framepos", "object": 10**6},
)
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
) -> Iterator[tuple[tuple[str, ...], FieldInfo]]:
    """Every key of a section and of the sections in it; a table of sections has the entry `*`."""
    for name, field in section.model_fields.items():
        yield (*path, name), field
        options = [field.annotation, *get_args(field.annotation)]
        table = any(str(getattr(o, "__origin__", "")) == "<class 'dict'>" for o in options)
        inner = [*options, *(arg for o in options for arg in get_args(o))]
        for option in inner:
            if isinstance(option, type) and issubclass(option, Section):
                yield from keys(option, (*path, name, *(("*",) if table else ())))


def words(annotation: Any) -> list[str]:
    """The literals of a type."""
    found = [] if get_origin(annotation) is not Literal else [*get_args(annotation)]
    return found + [word for arg in get_args(annotation) for word in words(arg)]


def takes(field: FieldInfo) -> list[Any]:
    """The strange values, and the literals, that a key takes by itself."""
    fields: dict[str, Any] = {"value": (field.annotation, field)}
    model = create_model("Key", __base__=Section, **fields)
    taken: list[Any] = []
    for value in (*WILD, *ODD, *words(field.annotation)):
        try:
            model.model_validate({"value": value})
        except ValidationError:
            continue
        taken.append(value)
    return taken


def cases(count: int, seed: int) -> Iterator[Case]:
    """Mutated scenarios."""
    known = dict(sorted(dict(keys()).items()))
    taken = {path: values for path, field in known.items() if (values := takes(field))}
    for i in range(count):
        rng = np.random.default_rng((seed, 1, i))
        robot = str(rng.choice(list(ROBOTS)))
        data = load(robot).model_dump(mode="json", exclude_none=True)
        data["simulation"] |= {"runs": 2, "duration": 0.05}
        label = str(rng.choice(ESTIMATORS))
        data["estimators"] = {label: {}}
        said: dict[str, tuple[Any, bool]] = {}
        for _ in range(int(rng.integers(1, 4))):
            bad = i % 2 == 1 and bool(rng.random() < 0.7)
            values: tuple[Any, ...] | list[Any] = WILD if bad else ODD
            if rng.random() < 0.2:
                path = ("estimators", label, str(rng.choice(SETTINGS)))
            else:
                paths = list(known if i % 2 else taken)
                path = paths[rng.integers(len(paths))]
                values = values if i % 2 else taken[path]
                names = ROBOTS[robot]
                path = tuple(str(rng.choice(names)) if part == "*" else part for part in path)
            value = values[rng.integers(len(values))]
            if _assign(data, path, value):
                said[".".join(path)] = value, bad and isinstance(value, float)
        name = ", ".join(f"{key}={value!r}" for key, (value, _) in said.items())
        yield Case(f"{robot}, {label}: {name}", _Run(data), any(wild for _, wild in said.values()))


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
