"""What a caller gives of the wrong type is refused in one line that names it; no `TypeError`."""

from pathlib import Path

import numpy as np
import pytest

import estbench
from estbench.envs.native import ScenarioEnv
from estbench.errors import EstbenchError
from estbench.study import axes

EYE = np.eye(2)
MODEL = estbench.LinearModel(0.9 * EYE, EYE, EYE, EYE)


@pytest.mark.parametrize("function", [estbench.load, estbench.open_results, estbench.open_study])
@pytest.mark.parametrize("source", [None, 7, [], np.nan, "x" * 5000, Path("x" * 300)])
def test_a_path(function, source):
    with pytest.raises(EstbenchError, match=r"(scenario|folder) is .*(use a path|too long)"):
        function(source)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"n_controls": np.eye(2)}, "n_controls is array"),
        ({"n_states": 1.5}, "n_states is 1.5; use a whole number"),
        ({"names": 1.5}, "names is 1.5; use 2 texts"),
        ({"units": "xy"}, "units is 'xy'; use 2 texts"),
        ({"angles": EYE}, "angles is array"),
        ({"state_angles": 1}, r"angles is 1; use a list of some of 0 to 1"),
    ],
)
def test_a_model(given, message):
    with pytest.raises(EstbenchError, match=message):
        estbench.FunctionModel(lambda x, u, t, dt: x, lambda x, u, t: x, EYE, EYE, **given)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"u": "x"}, "u is str of <U1"),
        ({"x": None}, "x is NoneType of object"),
        ({"mean": np.zeros((3, 2))}, r"mean has shape \(3, 2\) and cov \(2, 2\)"),
        ({"cov": np.zeros((0, 2))}, r"cov \(1, 0, 2\); expected"),
        ({"cov": -EYE}, "cov"),
        ({"times": [0.0, 2.0, 1.0]}, "times is .*; expected rising numbers"),
    ],
)
def test_a_bound(given, message):
    arguments = {"mean": np.zeros(2), "cov": EYE, "times": np.arange(3.0), "x": np.zeros((3, 4, 2))}
    with pytest.raises(EstbenchError, match=message):
        estbench.posterior_bound(MODEL, **(arguments | given))


@pytest.mark.parametrize(
    "kind", [estbench.KF, estbench.EKF, estbench.UKF, estbench.CKF, estbench.EnKF, estbench.IMM,
             estbench.ParticleFilter, estbench.RTS, estbench.MAP],
)  # fmt: skip
def test_an_estimator_without_a_model(kind):
    with pytest.raises(EstbenchError, match=f"{kind.__name__}: model is of type float; give a mod"):
        kind(1.0)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"normalize_actions": EYE}, "normalize_actions is"),
        ({"ghost": 1}, "ghost is 1; use True or False"),
        ({"overrides": "a=1"}, "overrides is 'a=1'; use a list"),
        ({"overrides": 1.5 * EYE}, "overrides is"),
        ({"width": "1"}, "width is '1'; use a whole number of pixels from 1 to 16384"),
        ({"height": np.inf}, "height is inf; use a whole number of pixels"),
    ],
)
def test_an_environment(given, message):
    with pytest.raises(EstbenchError, match=message):
        ScenarioEnv("pendulum", **given)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"iterations": []}, "iterations is .*; use a whole number"),
        ({"priors": ["x"]}, "priors is .*; use a table"),
        ({"free": "filter.process_noise_scale"}, "free is .*; use a list of keys"),
        ({"held_out": -1}, "held_out is -1; use a whole number of at least 0"),
        ({"workers": []}, r"workers is \[\]; use a whole number of at least 1"),
    ],
)
def test_a_tuning(given, message):
    with pytest.raises(EstbenchError, match=message):
        estbench.tune("pendulum", "ekf", **({"free": ["filter.process_noise_scale"]} | given))


@pytest.mark.parametrize("workers", [[], 0, 1.5, True])
def test_workers(workers):
    for call in (
        lambda: estbench.run("pendulum", "ekf", runs=2, workers=workers),
        lambda: estbench.sweep("pendulum", ["model.frame_skip=1"], "ekf", runs=2, workers=workers),
        lambda: estbench.budget("pendulum", "ekf", monte_carlo=True, runs=2, workers=workers),
    ):
        with pytest.raises(EstbenchError, match=r"workers is .*; use a whole number of at least 1"):
            call()


@pytest.mark.parametrize("estimators", [0, 1.5, False])
def test_estimators(estimators):
    with pytest.raises(EstbenchError, match=r"estimators is .*; use a label, a name, a class, or"):
        estbench.run("pendulum", estimators)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ([["a", "b"]], "type <U1"),
        ([0.5, 1.5], "type float64"),
        ([1], r"shape \(1,\); expected one"),
    ],
)
@pytest.mark.parametrize("kind", [estbench.KF, estbench.EnKF])
def test_keys(kind, keys, message):
    with pytest.raises(EstbenchError, match=f"keys has {message}"):
        estbench.follow(kind(MODEL), np.zeros((2, 2)), [EYE, EYE], np.zeros((1, 2, 2)), keys=keys)


def test_a_study_of_too_many_variants():
    ranges = [axes.parse(f"filter.{key}=lin:1:2:1000") for key in "ab"]
    with pytest.raises(EstbenchError, match="the study has 1,000,000 variants; use at most 100,00"):
        axes.grid(ranges)
    with pytest.raises(EstbenchError, match="the study has 1,000,000 variants"):
        axes.points(ranges[:1], "sobol", 10**6, 0)
    with pytest.raises(EstbenchError, match="points is True"):
        axes.points(ranges[:1], "sobol", True, 0)
