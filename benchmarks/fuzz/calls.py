"""Calls of the public functions with arguments that do not belong there."""

import inspect
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import estbench
from benchmarks.fuzz.case import Case
from estbench.envs.native import ScenarioEnv

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
        make = MAKERS[rng.integers(len(MAKERS))]
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


def _tune(rng: np.random.Generator) -> Case:
    free = "filter.process_noise_scale"
    given: dict[str, Any] = {"estimator": "ekf", "free": [free], "iterations": 2, "runs": 4}
    names = ("free", "objective", "coordinates", "priors", "method", "iterations", "runs", "seed",
             "held_out", "workers", "estimator")  # fmt: skip
    name, value = str(rng.choice(names)), _pick(rng, (*NUMBERS, [], {}, {free: NAN}, [free] * 2))
    return Case(
        f"tune({name}={_shown(value)})", partial(_called, estbench.tune, given | {name: value})
    )


def _filtered(kind: Any, given: dict[str, Any], folder: Path) -> str:
    """A smoother smooths what its filter has found."""
    estimator = kind(_model(), **given)
    prior = np.zeros((3, 2)), np.tile(EYE, (3, 1, 1))
    keys = np.arange(3, dtype=np.uint64) if hasattr(estimator, "size") else None
    history = estbench.follow(estimator, *prior, np.ones((5, 3, 2)), keys=keys)
    if hasattr(estimator, "smooth"):
        estimator.smooth(history)
    return f"NIS {np.nanmean(history.nis):.3g}"


def _estimator(rng: np.random.Generator) -> Case:
    kinds = (estbench.EKF, estbench.IEKF, estbench.UKF, estbench.CKF, estbench.KF, estbench.EnKF,
             estbench.ParticleFilter, estbench.IMM, estbench.RTS, estbench.URTS,
             estbench.MAP)  # fmt: skip
    kind: Any = kinds[rng.integers(len(kinds))]
    name = str(rng.choice(list(inspect.signature(kind).parameters)))
    value = _pick(rng, (*NUMBERS, {}, "nonsense", [[1.0]], [NAN, NAN]))
    if name == "model":
        return Case(f"{kind.__name__}({_shown(value)})", partial(_modelled, kind, value))
    text = f"{kind.__name__}({name}={_shown(value)})"
    return Case(text, partial(_filtered, kind, {name: value}))


def _modelled(kind: Any, model: Any, folder: Path) -> str:
    prior = np.zeros((3, 2)), np.tile(EYE, (3, 1, 1))
    return str(estbench.follow(kind(model), *prior, np.ones((5, 3, 2))))[:80]


def _functions(given: dict[str, Any], folder: Path) -> str:
    arguments: dict[str, Any] = {
        "f": lambda x, u, t, dt: 0.9 * x, "h": lambda x, u, t: x, "Q": 0.1 * EYE, "R": EYE
    } | given  # fmt: skip
    model = estbench.FunctionModel(**arguments)
    prior = np.zeros((3, 2)), np.tile(EYE, (3, 1, 1))
    return f"NIS {np.nanmean(estbench.follow(estbench.EKF(model), *prior, np.ones((5, 3, 2))).nis)}"


def _function_model(rng: np.random.Generator) -> Case:
    names = list(inspect.signature(estbench.FunctionModel).parameters)
    name, value = str(rng.choice(names)), _pick(rng, (*ARRAYS, *NUMBERS, lambda *given: given))
    return Case(f"FunctionModel({name}={_shown(value)})", partial(_functions, {name: value}))


def _bounded(given: dict[str, Any], folder: Path) -> str:
    arguments: dict[str, Any] = {
        "model": _model(), "mean": np.zeros(2), "cov": EYE, "times": np.arange(4.0),
        "x": np.zeros((4, 3, 2)),
    } | given  # fmt: skip
    return str(estbench.posterior_bound(**arguments).cov[-1].trace())


def _bound(rng: np.random.Generator) -> Case:
    name, value = str(rng.choice(["mean", "cov", "times", "x", "u"])), _pick(rng, ARRAYS)
    return Case(f"posterior_bound({name}={_shown(value)})", partial(_bounded, {name: value}))


def _opened(function: Callable[[Any], Any], source: Any, folder: Path) -> str:
    return " ".join(str(function(source)).split())[:80]


def _open(rng: np.random.Generator) -> Case:
    function = (estbench.load, estbench.open_results, estbench.open_study)[rng.integers(3)]
    source = _pick(
        rng, (*NUMBERS, "", ".", "/", "x" * 5000, "a\x00b", Path("/dev/null"), "nothing")
    )
    text = f"{function.__name__}({_shown(source)})"
    return Case(text, partial(_opened, function, source))


def _stepped(given: dict[str, Any], action: Any, folder: Path) -> str:
    arguments: dict[str, Any] = {"scenario": "cartpole"} | given
    env = ScenarioEnv(**arguments)
    try:
        env.reset(seed=0)
        return f"reward {env.step(action)[1]}"
    finally:
        env.close()


def _environment(rng: np.random.Generator) -> Case:
    names = ("action", *inspect.signature(ScenarioEnv).parameters)
    name, value = str(rng.choice(names)), _pick(rng, (*NUMBERS, *ARRAYS[:8], {}))
    given, action = ({}, value) if name == "action" else ({name: value}, np.zeros(1, np.float32))
    return Case(f"environment({name}={_shown(value)})", partial(_stepped, given, action))


MAKERS: tuple[Callable[[np.random.Generator], Case], ...] = (
    _follow, _linear, _run, _sweep, _tune, _estimator, _estimator, _function_model, _bound, _open,
    _environment,
)  # fmt: skip
