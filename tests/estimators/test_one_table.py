"""Every estimator of `estbench list` in one table, on the same truth and the same readings."""

import sys

import numpy as np
import pytest

from benchmarks import contact
from benchmarks import estimators as benchmark
from benchmarks.contact_conditions import CONDITIONS
from estbench.estimators.names import BUILTIN
from estbench.experiment import setup
from estbench.montecarlo import run as experiment
from estbench.scenario.schema import Scenario
from tests.helpers import LEGGED, OTHER, SAMPLED

SMALL = ["estimators.enkf={size=20}", "estimators.pf={size=500}"]
ALIKE = [
    *("sr_ekf", "iekf", "ukf", "sr_ukf", "ckf", "ghkf", "rotated_ukf", "iplf", "diplf"),
    *("schmidt_ekf", "bias_ekf", "bias_ukf"),
    *("converted_ekf", "filterpy_ekf", "filterpy_ukf", "stonesoup_ekf", "stonesoup_ukf"),
]
"""With default settings, the EKF on a robot that hardly bends."""


@pytest.mark.parametrize("robot", ["pendulum", "cartpole"])
def test_all_of_them(robot):
    names = [name for name in BUILTIN if name not in LEGGED]
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
    words = ["--runs", "2", "--duration", "0.02", "--robots", "walker2d", "--only", "rotated_ukf",
             "--conditions", "encoders and IMU only"]  # fmt: skip
    monkeypatch.setattr(sys, "argv", ["contact", *words])
    contact.main()
    title, head, _, *lines = capsys.readouterr().out.strip().splitlines()
    rows = [line for line in lines if line.startswith("|")]
    assert title == "## walker2d, encoders and IMU only, seed 0, 2 runs of 0.02 s"
    assert [row.split("|")[1].strip() for row in rows] == ["`ukf`", "`rotated_ukf`"]
    assert {row.count("|") for row in rows} == {head.count("|")}
    found = contact.scenario("walker2d")["channels"]
    assert {"thigh_left_joint_encoder", "foot_joint_encoder", "rootx_encoder"} <= found.keys()
    assert contact.scenario("humanoid")["channels"].keys() >= {"left_knee_encoder", "attitude"}


def test_the_conditions_of_the_benchmark_of_contact_change_what_they_say():
    plain, *others = (
        setup.build(Scenario.model_validate(change(contact.scenario("ant"))))
        for change in CONDITIONS.values()
    )
    less, more, noisy, blind, same, skipping, light = others
    Q = [p.model().process_noise(p.mean[None], np.zeros((1, 8)), 0.0, 0.01) for p in (plain, less)]
    np.testing.assert_allclose(Q[1], 0.1 * Q[0], rtol=1e-9)
    R, wide = (p.model().measurement_noise(0.0) for p in (plain, noisy))
    np.testing.assert_allclose(wide, 9 * R, rtol=1e-9)
    assert [c.name for c in blind.channels][-3:] == ["ankle_4_encoder", "gyro", "accelerometer"]
    assert skipping.plant.period == 5 * same.plant.period == 5 * plain.plant.period
    true, believed = light.plant.model, light.model().mjmodel
    np.testing.assert_allclose(believed.body_mass, 0.9 * true.body_mass)
    np.testing.assert_allclose(believed.geom_friction, 0.9 * true.geom_friction)
    assert more.plant.model.opt.timestep == true.opt.timestep
