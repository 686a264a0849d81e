"""Every estimator of `estbench list` in one table, on the same truth and the same readings."""

import sys

import numpy as np
import pytest

from benchmarks import contact
from benchmarks import estimators as benchmark
from estbench.estimators import registry
from estbench.montecarlo import run as experiment
from tests.helpers import OTHER, SAMPLED

SMALL = ["estimators.enkf={size=20}", "estimators.pf={size=500}"]
ALIKE = [
    *("sr_ekf", "iekf", "ukf", "sr_ukf", "ckf", "ghkf", "rotated_ukf", "iplf", "diplf"),
    *("schmidt_ekf", "bias_ekf", "bias_ukf"),
    *("converted_ekf", "filterpy_ekf", "filterpy_ukf", "stonesoup_ekf", "stonesoup_ukf"),
]
"""With default settings, the EKF on a robot that hardly bends."""


@pytest.mark.parametrize("robot", ["pendulum", "cartpole"])
def test_all_of_them(robot):
    names = list(registry.BUILTIN)
    results = experiment.run(robot, names, runs=3, duration=0.2, overrides=SMALL)
    assert [s.label for s in results.summaries] == names
    rmse = {name: [i.value for i in results[name].rmse] for name in names}
    assert all(results[name].diverged == 0 for name in names)
    assert all(results[name].cost > 0 for name in names)
    for name in ALIKE:
        np.testing.assert_allclose(rmse[name], rmse["ekf"], rtol=0.02, err_msg=name)
    for name in ("rts", "urts", "ipls", "map"):
        assert np.mean(rmse[name]) < np.mean(rmse["ekf"])
    for name in SAMPLED | OTHER | {"lkf", "kf", "cd_ekf"}:
        assert (np.array(rmse[name]) < 3.0 * np.array(rmse["ekf"])).all(), name


def test_the_benchmark_prints_a_row_for_each(monkeypatch, capsys):
    words = ["--runs", "2", "--duration", "0.05", "--only", "ekf", "rts"]
    monkeypatch.setattr(sys, "argv", ["estimators", *words])
    benchmark.main()
    printed = capsys.readouterr().out
    for robot in benchmark.ROBOTS:
        table = printed.partition(f"## {robot}\n")[2].splitlines()
        assert [row.split("|")[1].strip() for row in table[2:4]] == ["`ekf`", "`rts`"]
        assert {row.count("|") for row in table[:4]} == {table[0].count("|")}


def test_the_benchmark_of_contact_prints_a_row_for_each(monkeypatch, capsys):
    """`walker2d` has no example of its own: it is sensed like the hopper."""
    words = ["--runs", "2", "--duration", "0.02", "--robots", "walker2d", "--only", "rotated_ukf"]
    monkeypatch.setattr(sys, "argv", ["contact", *words])
    contact.main()
    title, head, _, *rows = capsys.readouterr().out.strip().splitlines()
    assert title == "## walker2d, seed 0, 2 runs of 0.02 s"
    assert [row.split("|")[1].strip() for row in rows] == ["`ukf`", "`rotated_ukf`"]
    assert {row.count("|") for row in rows} == {head.count("|")}
    found = contact.scenario("walker2d")["channels"]
    assert {"thigh_left_joint_encoder", "foot_joint_encoder", "rootx_encoder"} <= found.keys()
    assert contact.scenario("humanoid")["channels"].keys() >= {"left_knee_encoder", "attitude"}
