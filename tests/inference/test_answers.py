"""Broken and dishonest estimators are named; those that only err as statistics are judged."""

from dataclasses import replace

import numpy as np
import pytest

import estbench
from benchmarks import dishonest
from estbench.errors import EstbenchError
from estbench.estimators import registry
from estbench.estimators.ekf import EKF
from estbench.following import follow
from estbench.inference.answers import Answers, kept
from estbench.models.linear import LinearModel


@pytest.mark.parametrize("name", dishonest.EXPECTED)
def test_it_is_named_or_left_to_the_verdict(name):
    found = dishonest.said(name, runs=3, duration=0.12)
    assert (found.outcome == "named") == (dishonest.EXPECTED[name] == "named"), found.text
    assert len(found.text.splitlines()) == 1
    if found.outcome == "named" and "runs failed" not in found.text:
        assert found.text.startswith(name)


def stops(*arguments, **keywords):
    raise SystemExit(3)


@pytest.mark.parametrize("method", ["__init__", "init", "predict", "update", "check_schedule"])
def test_a_plug_in_that_exits_is_named(method, monkeypatch):
    plug_in = type("PlugIn", (EKF,), {method: stops, "__module__": __name__})
    monkeypatch.setitem(globals(), "PlugIn", plug_in)
    with pytest.raises(EstbenchError, match=r"PlugIn.*(raised|Exit).*SystemExit: 3"):
        estbench.run("pendulum", plug_in, runs=2, duration=0.05)


class Coded(EKF):
    """A belief whose fault is no `Fault`."""

    def update(self, belief, *arguments, **keywords):
        belief, innovation = super().update(belief, *arguments, **keywords)
        return replace(belief, mean=belief.mean + np.nan, fault=belief.fault + 77), innovation


def test_an_unknown_fault_is_named():
    with pytest.raises(EstbenchError, match=r"Coded: the fault of its belief is \d+; .* 0 to 8"):
        estbench.run("pendulum", Coded, runs=2, duration=0.05)


CHAIN = LinearModel(A=np.array([[1.0, 0.1], [0, 1]]), C=np.eye(2), Q=0.01 * np.eye(2), R=np.eye(2))


@pytest.mark.parametrize("name", [n for n, e in dishonest.EXPECTED.items() if e == "named"])
def test_follow_names_them_too(name):
    y = np.random.default_rng(0).standard_normal((4, 3, 2))
    estimator = getattr(dishonest, name)(CHAIN)
    mean = np.tile([[0.0], [0.1], [0.3]], 2)
    message = ""
    try:
        history = follow(estimator, mean, np.tile(np.eye(2), (3, 1, 1)), y)
    except EstbenchError as error:
        message = str(error)
    if message:
        assert message.startswith(name)
        return
    failed = ~np.isfinite([estimator.mean(b) for b in history.beliefs]).all(axis=(0, 2))
    failed |= ~np.isfinite([estimator.cov(b) for b in history.beliefs]).all(axis=(0, 2, 3))
    smallest = [np.linalg.eigvalsh(estimator.cov(history.beliefs[-1]))[:, 0] < 0]
    assert (failed | (history.fault > 0) | smallest).any()


@pytest.mark.parametrize("name", ["ekf", "ukf", "sr_ekf", "pf", "enkf", "imm", "robust_ekf"])
def test_what_estbench_returns_passes_every_check(name):
    y = np.random.default_rng(1).standard_normal((20, 3, 2))
    y[3, 1, 0] = y[5] = np.nan
    estimator = registry.create(name, {}, CHAIN)
    answers = Answers(estimator)
    assert answers.own
    answers.own = False  # as thorough as for a user's
    belief = estimator.init(np.zeros((3, 2)), np.tile(np.eye(2), (3, 1, 1)))
    none = np.zeros((3, 0))
    for k, reading in enumerate(y):
        belief = estimator.predict(belief, none, float(k), 1.0)
        mask = ~np.isnan(reading)
        answer = estimator.update(belief, np.nan_to_num(reading), none, k + 1.0, mask=mask)
        belief, innovation = answers.checked(answer, ("y",), 3, 2)
        assert answers.innovation(belief, innovation, mask) is None
        _, cov = answers.moments(belief, 3, 2, 2)
        assert answers.asymmetry(cov) is None


def test_the_covariance_of_an_unsymmetrized_filter_is_symmetric_to_rounding():
    class Simplified(EKF):
        def cov(self, belief):
            skew = np.array([[0, 1e-9], [-1e-9, 0]])
            return belief.cov * (1 + skew)

    y = np.random.default_rng(1).standard_normal((20, 2, 2))
    history = follow(Simplified(CHAIN), np.zeros((2, 2)), np.tile(np.eye(2), (2, 1, 1)), y)
    assert not history.fault.any()


def test_the_first_fault_of_a_run_stays():
    old, new = np.array([0, 6, 0], np.uint8), np.array([5, 5, 0], np.uint8)
    np.testing.assert_array_equal(kept(old, new), [5, 6, 0])
    np.testing.assert_array_equal(kept(old, None), old)
