"""Absurd sizes are refused at once, with the figure, before anything is compiled or allocated."""

import time

import pytest

import estbench
from estbench.errors import EstbenchError
from estbench.experiment import setup, size
from estbench.scenario.load import resolve


@pytest.mark.parametrize(
    ("estimator", "override", "message"),
    [
        ("ekf", "model.frame_skip=1000000000", r"frame_skip is 1000000000: .* at least 500 s"),
        ("ekf", "simulation.runs=2000000000", r"the averages of 2000000000 runs take at least 745"),
        ("ekf", "simulation.duration=1e9", r"days of one core|instants"),
        ("enkf", "estimators.enkf.size=100000000", r"enkf: size is 100000000: .* at least 50 s"),
        ("pf", "estimators.pf.size=1000000000", r"pf: size is 1000000000: .* at least 500 s"),
        ("ghkf", "estimators.ghkf.order=100", r"100\^2 points \(at most 5000\)"),
        ("robust_ekf", "estimators.robust_ekf.iterations=1000000", r"at most 1000"),
    ],
)
def test_it_is_refused_at_once(estimator, override, message):
    began = time.process_time()
    with pytest.raises(EstbenchError, match=message):
        estbench.run("pendulum", estimator, overrides=[override])
    assert time.process_time() - began < 5  # it takes 0.1 s; the experiment would take days


def test_beliefs_that_exceed_the_memory_are_refused_with_the_figure(monkeypatch):
    monkeypatch.setattr(size, "free_memory", lambda: 2**20)
    resolved = resolve("pendulum", "enkf", runs=10, overrides=["estimators.enkf.size=10000"])
    with pytest.raises(EstbenchError, match=r"beliefs of 10 runs .* 0\.00\d+ GiB .* 0\.000977 are"):
        setup.build(resolved)
    monkeypatch.setattr(size, "free_memory", lambda: None)  # a system that does not tell
    assert setup.build(resolved)
