"""FilterPy's and Stone Soup's filters in the same protocol, agreeing with ours as they should."""

import builtins
import importlib

import numpy as np
import pytest

from estbench.errors import EstimatorError, MissingExtraError
from estbench.estimators import registry
from estbench.estimators.adapters import stonesoup
from estbench.estimators.beliefs import Fault
from estbench.estimators.names import BUILTIN
from estbench.estimators.protocol import Estimator
from estbench.montecarlo import run as experiment
from tests.helpers import PEERS, linear_model, mujoco_model, nonlinear_model, random_cov

ROOTS = {"filterpy": "filterpy", "stonesoup": "stonesoup"}
OURS = {name: name.partition("_")[2] for name in sorted(PEERS)}
SETTINGS = {"alpha": 0.7, "beta": 1.5, "kappa": 0.5}


@pytest.fixture
def installed(name):
    pytest.importorskip(name.partition("_")[0])


def drive(estimator, seed, steps=4, runs=3):
    model = estimator.model
    n, m = model.space.n, model.output().n
    rng = np.random.default_rng(seed)
    belief = estimator.init(0.3 * rng.standard_normal((runs, n)), random_cov(rng, n, runs))
    out = []
    for k in range(steps):
        u, y = rng.standard_normal((runs, model.nu)), rng.standard_normal((runs, m))
        mask = rng.random((runs, m)) > 0.3
        mask[0], mask[1] = True, k == 2
        belief = estimator.predict(belief, u, 0.1 * k, 0.1)
        belief, i = estimator.update(belief, y, u, 0.1 * k + 0.1, None, None if k == 3 else mask)
        out.append([estimator.mean(belief), estimator.cov(belief), i.residual, i.cov, i.nis,
                    i.white, i.dof])  # fmt: skip
    return out


@pytest.mark.parametrize("name", OURS)
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("kind", ["linear", "nonlinear", "tuned"])
def test_equals_ours(kind, name, seed, installed):
    model = linear_model(seed) if kind == "linear" else nonlinear_model(4)
    settings = SETTINGS if kind == "tuned" and name.endswith("ukf") else {}
    peer, ours = (registry.create(k, settings, model) for k in (name, OURS[name]))
    assert isinstance(peer, Estimator)
    for theirs, expected in zip(drive(peer, seed), drive(ours, seed)):
        for a, b in zip(theirs, expected):
            np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("name", OURS)
def test_in_one_table(name, installed):
    results = experiment.run("cartpole", [OURS[name], name], runs=3, duration=0.1)
    ours, theirs = results.records[OURS[name]], results.records[name]
    for key in ("anees", "anis", "mse", "variance", "fault"):
        np.testing.assert_allclose(theirs[key], ours[key], rtol=1e-6)


@pytest.mark.parametrize("name", ["filterpy_ukf", "stonesoup_ekf"])
def test_a_run_that_fails_is_marked_and_leaves_the_others_alone(name, installed):
    model = nonlinear_model(4)
    estimator = registry.create(name, {}, model)
    cov = np.tile(np.eye(4), (2, 1, 1))
    cov[1] = -np.eye(4)
    belief = estimator.init(np.zeros((2, 4)), cov)
    u = np.zeros((2, 1))
    belief = estimator.predict(belief, u, 0.0, 0.1)
    if name == "filterpy_ukf":
        assert belief.fault.tolist() == [Fault.NONE, Fault.COVARIANCE]
        assert np.isnan(belief.mean[1]).all()
    belief, innovation = estimator.update(belief, np.ones((2, 3)), u, 0.1)
    assert np.isfinite(belief.mean[0]).all()
    assert innovation.dof.tolist() == [3, 3]


@pytest.mark.parametrize("name", OURS)
def test_quaternions_are_refused(name, installed):
    with pytest.raises(EstimatorError, match=r"(FilterPy|StoneSoup).KF: the state holds a quat"):
        registry.create(name, {}, mujoco_model("joints"))


@pytest.mark.parametrize("name", ["filterpy_ukf", "stonesoup_ukf"])
@pytest.mark.parametrize(("setting", "value"), [("alpha", 0.0), ("beta", -1.0), ("kappa", "big")])
def test_bad_settings(name, setting, value, installed):
    with pytest.raises(EstimatorError, match=rf"UKF: {setting} is {value!r}; use a number"):
        registry.create(name, {setting: value}, linear_model(0))


@pytest.mark.parametrize("name", OURS)
def test_a_library_that_is_not_there(name, monkeypatch):
    real = importlib.import_module

    def absent(module, *args):
        if module.startswith(tuple(ROOTS)):
            raise ImportError(module)
        return real(module, *args)

    monkeypatch.setattr(importlib, "import_module", absent)
    stonesoup.library.cache_clear()
    with pytest.raises(MissingExtraError, match=r"pip install 'estbench\[peers\]'"):
        registry.create(name, {}, linear_model(0))


def test_neither_is_imported_before_it_is_used(monkeypatch):
    real = builtins.__import__

    def watched(name, *args, **kwargs):
        assert not name.startswith(tuple(ROOTS))
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", watched)
    for name in OURS:
        importlib.reload(importlib.import_module(BUILTIN[name].partition(":")[0]))
