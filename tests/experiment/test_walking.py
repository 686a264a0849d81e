"""The bundled robots with legs: they stand, walk and do not fall, and filters follow them."""

import sys

import numpy as np
import pytest

from benchmarks import legged
from estbench.experiment import setup
from estbench.experiment.recording import trajectory
from estbench.montecarlo import run as experiment
from estbench.spaces import rotation


@pytest.mark.parametrize(
    ("robot", "height", "way"), [("quadruped", 0.28, 0.1), ("biped", 0.26, 0.1)]
)
def test_it_stands_then_walks_and_does_not_fall(robot, height, way):
    prepared = setup.build(experiment.resolve(robot))
    x = trajectory(prepared, range(4)).x
    up = rotation.matrix(x[..., 3:7])[..., 2, 2]
    assert up.min() > np.cos(0.15)
    np.testing.assert_allclose(x[..., 2], height, atol=0.1 * height)
    begin = np.searchsorted(prepared.times, prepared.scenario.control.begin)
    start = x[0, :, 0]
    np.testing.assert_allclose(x[begin, :, 0], start, atol=0.03)  # it stands
    assert (x[-1, :, 0] - start > way).all()  # it has walked


@pytest.mark.parametrize("robot", ["quadruped", "biped"])
def test_filters_of_legs_follow_it(robot):
    """The velocity of the base to a few cm/s. Of 3 runs: NEES/n has mean 1 and std below 0.1."""
    names = ["contact_ekf", "contact_inekf"]
    early = ["bound=false", "control.begin=0.0", "control.ramp=0.1"]
    results = experiment.run(robot, names, runs=3, duration=0.25, seed=1, overrides=early)
    for name in names:
        s = results[name]
        assert s.diverged == 0
        assert not s.failures
        speed = [i.value for n, i in zip(results.names, s.rmse) if n.startswith("root.v")]
        assert max(speed) < 0.05
        assert 0.5 < s.anees.value < 1.5
    first, second = (results[name].anees.value for name in names)
    np.testing.assert_allclose(first, second, rtol=0.1)


def test_the_benchmark_prints_a_row_for_each(monkeypatch, capsys):
    short = ["--runs", "2", "--duration", "0.02", "--robots", "biped"]
    monkeypatch.setattr(sys, "argv", ["legged", *short, "--only", "contact_ekf", "symmetric"])
    legged.main()
    table, reasons = capsys.readouterr().out.strip().split("\n\n")
    title, head, _, *rows = table.splitlines()
    assert title == "## biped, seed 1, 2 runs of 0.02 s"
    assert [row.split("|")[1].strip() for row in rows] == ["`contact_ekf`", "`symmetric`"]
    assert {row.count("|") for row in rows} == {head.count("|")}
    assert reasons.startswith("`contact_ekf`: ")
