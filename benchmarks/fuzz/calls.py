"""Calls of the public functions with arguments that do not belong there."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import estbench
from benchmarks.fuzz.case import Case

NAN, EYE = float("nan"), np.eye(2)
ARRAYS: tuple[Any, ...] = (
    np.zeros((0, 2)), np.full((3, 2), np.nan), np.full((3, 2), np.inf), np.zeros(3), np.eye(3),
    np.eye(2) * 1j, np.array([["a", "b"]]), None, "x", 7, np.zeros((3, 2, 2, 2)), -np.eye(2),
    np.array([[1.0, 2.0], [0.0, 1.0]]), np.ma.masked_all((3, 2)), [[1, 2], [3]], 1e308 * np.eye(2),
)  # fmt: skip
NUMBERS: tuple[Any, ...] = (-1, 0, 1.5, NAN, True, "1", None, 10**30, [], float("inf"))


def cases(count: int, seed: int) -> Iterator[Case]:
    """Calls with one argument replaced."""
    for i in range(count):
        rng = np.random.default_rng((seed, 4, i))
        make = (_follow, _linear, _run, _sweep)[rng.choice(4, p=[0.4, 0.2, 0.3, 0.1])]
        yield make(rng)


def _pick(rng: np.random.Generator, values: tuple[Any, ...]) -> Any:
    return values[rng.integers(len(values))]


def _shown(value: Any) -> str:
    return " ".join(repr(value).split())[:60]


def _model(**given: Any) -> estbench.LinearModel:
    matrices = {"A": 0.9 * EYE, "C": EYE, "Q": 0.1 * EYE, "R": EYE} | given
    return estbench.LinearModel(**matrices)


def _followed(given: dict[str, Any], folder: Path) -> str:
    arguments: dict[str, Any] = {
        "mean": np.zeros((3, 2)), "cov": np.tile(EYE, (3, 1, 1)), "y": np.ones((5, 3, 2))
    } | given  # fmt: skip
    history: Any = estbench.follow(estbench.EKF(_model()), **arguments)
    return f"NIS {np.nanmean(history.nis):.3g}"


def _follow(rng: np.random.Generator) -> Case:
    name, value = str(rng.choice(["mean", "cov", "y", "u", "times", "keys"])), _pick(rng, ARRAYS)
    return Case(f"follow({name}={_shown(value)})", partial(_followed, {name: value}))


def _built(given: dict[str, Any], folder: Path) -> str:
    model = _model(**given)
    history = estbench.follow(
        estbench.KF(model), np.zeros((3, 2)), np.tile(EYE, (3, 1, 1)), np.ones((5, 3, 2))
    )
    return f"NIS {np.nanmean(history.nis):.3g}"


def _linear(rng: np.random.Generator) -> Case:
    name, value = str(rng.choice(["A", "C", "Q", "R", "B"])), _pick(rng, ARRAYS)
    return Case(f"LinearModel({name}={_shown(value)})", partial(_built, {name: value}))


def _called(function: Callable[..., Any], given: dict[str, Any], folder: Path) -> str:
    arguments: dict[str, Any] = {"scenario": "pendulum", "runs": 2, "duration": 0.05} | given
    return " ".join(str(function(**arguments)).split())[:80]


def _run(rng: np.random.Generator) -> Case:
    names = ("runs", "seed", "duration", "batch_size", "workers", "keep", "dtype", "estimators",
             "shard", "executor", "overrides", "scenario", "out")  # fmt: skip
    name, value = str(rng.choice(names)), _pick(rng, NUMBERS)
    return Case(f"run({name}={_shown(value)})", partial(_called, estbench.run, {name: value}))


def _sweep(rng: np.random.Generator) -> Case:
    over = ("filter.process_noise_scale=" + str(rng.choice(
        ["", "nan", "1e300", "lin:1:2:0", "log:0:1:3", "lin:1:2:10000000", "a,b", "1,1", "log:1"]
    )),)  # fmt: skip
    given = {"over": over, "estimators": "ekf"}
    return Case(f"sweep({over[0]})", partial(_called, estbench.sweep, given))
