# pyright: reportOptionalMemberAccess=false, reportArgumentType=false
# pyright: reportOptionalSubscript=false, reportGeneralTypeIssues=false
import json

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

from estbench.commands.cli import app
from estbench.consistency.intervals import mean_interval
from estbench.envs.control import Comparison, Outcome, compare
from estbench.envs.control_table import render
from estbench.envs.errors import EnvError
from estbench.envs.raw import RawReadings
from estbench.envs.task import Task
from estbench.envs.world import World, prepare
from estbench.errors import EstbenchError, EstimatorError, ScenarioError
from estbench.experiment import setup
from estbench.montecarlo.run import resolve
from tests.helpers import simulated


def test_common_random_numbers_and_paired_differences():
    a = compare("cartpole", ["ekf"], controller="lqr", runs=12, duration=0.5)
    b = compare("cartpole", ["ekf", "ukf"], controller="lqr", runs=5, duration=0.5)
    assert [s.label for s in b.sources] == ["truth", "ekf", "ukf", "raw"]
    for label in ("truth", "ekf", "raw"):  # a run does not depend on its company
        np.testing.assert_allclose(a[label].cost[:5], b[label].cost, rtol=1e-9)
    expected = mean_interval(a["ekf"].cost - a["truth"].cost)
    assert a.difference("ekf", "truth") == expected
    assert a.cost("truth").value < a.cost("ekf").value < a.cost("raw").value
    loose = a.cost("ekf").high - a.cost("ekf").low
    assert expected.high - expected.low < loose
    other = compare("cartpole", ["ekf"], controller="lqr", runs=2, duration=0.5, seed=3)
    assert not np.isclose(other["ekf"].cost, a["ekf"].cost[:2]).any()


def test_the_runs_are_those_of_the_command_run():
    compared = compare("cartpole", ["ekf"], controller="lqr", runs=4, duration=0.5, seed=2)
    truth = ['control.observe="truth"']
    prepared = setup.build(resolve("cartpole", ["ekf"], seed=2, duration=0.5, overrides=truth))
    trajectory, task = simulated(prepared, 4), Task.build(prepared.scenario, prepared.plant)
    steps = list(zip(trajectory.x[1:], trajectory.u))
    cost = np.mean([task.cost(x, u) for x, u in steps], axis=0)
    np.testing.assert_allclose(compared["truth"].cost, cost, rtol=1e-12)


def test_failures_are_counted_with_their_time_and_left_out():
    c = compare("cartpole_imu", ["ekf"], controller="lqr", runs=6, duration=3.0)
    raw = c["raw"]  # no sensor reads the pole
    assert raw.failed.sum() >= 4
    np.testing.assert_array_equal(np.isfinite(raw.failed_at), raw.failed)
    assert not c["ekf"].failed.any()
    both = (c["ekf"].cost - raw.cost)[~raw.failed]
    assert np.isclose(
        c.difference("ekf", "raw").value, both.mean() if both.size else np.nan, equal_nan=True
    )
    data = json.loads(json.dumps(c.to_dict(), allow_nan=False))
    assert data["sources"]["raw"]["failures"] == raw.failed.sum()


def test_with_an_exact_filter_the_estimate_costs_what_the_truth_costs():
    exact = ["initial.std=1e-9", "process_noise.density=0"]
    c = compare("cartpole", ["ekf"], controller="lqr", runs=3, duration=0.3, overrides=exact)
    np.testing.assert_allclose(c["ekf"].cost, c["truth"].cost, atol=1e-9)


@pytest.mark.parametrize("name", ["cartpole", "quadrotor"])
def test_raw_readings(name):
    fast = {"quadrotor": ["channels.position.rate=200", "channels.attitude.rate=200"]}.get(name, [])
    raw = {"type": "estbench.envs.raw:RawReadings"}
    world = World(prepare(name, raw, None, fast), 1, look=True)
    world.reset(np.zeros(1, np.int64), 5, [0])
    bank, suite, u0 = world.filter, world.simulator.suite, world.setup.plant.u0[None]
    dt = world.setup.plant.period
    nq, nv = world.setup.plant.model.nq, world.setup.plant.model.nv
    before = bank.estimate[0].copy()
    for k in range(4):
        world.step(u0)
        x, y = bank.estimate[0], suite.latest[0]
        if name == "cartpole":
            np.testing.assert_allclose(x[:nq], y, atol=1e-9)
            if k:
                np.testing.assert_allclose(x[nq:], (x[:nq] - before[:nq]) / dt, atol=1e-6)
        else:  # accel, gyro, position, attitude
            np.testing.assert_allclose(x[:3], y[6:9], atol=1e-6)
            np.testing.assert_allclose(np.abs(x[3:7] @ y[9:]), 1, atol=1e-5)
            np.testing.assert_allclose(x[nq + 3 :], y[3:6], atol=1e-5)
            if k:
                np.testing.assert_allclose(x[nq : nq + 3], (x[:3] - before[:3]) / dt, atol=1e-3)
        assert nv == len(world.setup.space.names) // 2
        before = x.copy()


def test_raw_readings_of_slow_sensors_difference_over_their_period():
    rates = ["channels.cart_encoder.rate=25", "channels.pole_encoder.rate=50"]
    world = World(prepare("cartpole", {"type": "estbench.envs.raw:RawReadings"}, None, rates), 1)
    world.reset(np.zeros(1, np.int64), 5, [0])
    bank, seen = world.filter, []
    for _ in range(8):
        world.step(np.zeros((1, 1)))
        seen.append(bank.estimate[0].copy())
    cart = np.array(seen)[:, 0]
    assert len(set(cart[:3])) == 1
    assert len(set(cart[3:7])) == 1
    np.testing.assert_allclose(seen[7][2], (cart[7] - cart[3]) / 0.04, atol=1e-9)
    assert isinstance(bank.estimator, RawReadings)


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        ({"controller": "lqrr"}, EnvError, "no controller 'lqrr' .did you mean 'lqr'"),
        ({"runs": 0}, EnvError, "runs is 0"),
        ({"estimators": ["efk"]}, EstimatorError, "no estimator 'efk'"),
        ({"duration": -1}, ScenarioError, "task.horizon"),
        ({"overrides": ["estimators.raw={type='ekf'}"]}, EnvError, "label 'raw' is taken"),
    ],
)
def test_bad_arguments(kwargs, error, message):
    with pytest.raises(error, match=message):
        compare("cartpole", **{"runs": 2, **kwargs})
    assert issubclass(EnvError, EstbenchError)


def test_command_line():
    arguments = ["control", "cartpole", "--controller", "lqr", "--runs", "3", "--duration", "0.2"]
    text = CliRunner().invoke(app, arguments).output
    assert "cartpole: lqr on truth, estimates and raw readings, 3 runs x 0.2 s, seed 0" in text
    assert "minus truth" in text
    assert text.count("0/3") == 4
    assert max(len(line) for line in text.splitlines()) <= 100
    data = json.loads(CliRunner().invoke(app, [*arguments, "-e", "ekf", "--json"]).output)
    assert set(data["sources"]) == {"truth", "ekf", "raw"}
    assert data["runs"] == 3


def test_the_table_breaks_no_name_and_no_number():
    names = ("truth", "a_filter_whose_name_is_long_enough_to_see", "raw")
    costs = ([1e6, 1e6 + 1], [2e7, 2e7 + 3], [3.0, 9e99])
    failed = (np.zeros(2, bool), np.array([False, True]), np.zeros(2, bool))
    sources = (
        Outcome(n, np.array(c), f, np.full(2, np.nan)) for n, c, f in zip(names, costs, failed)
    )
    console = Console(width=100, no_color=True, force_terminal=False, highlight=False)
    with console.capture() as capture:
        console.print(render(Comparison("robot", "lqr", 0, 1.0, 0.95, tuple(sources))))
    lines = [line.rstrip() for line in capture.get().splitlines()]
    assert max(map(len, lines)) <= 100
    found = {
        name: " ".join(w for line in lines if line.startswith(f"{name} ") for w in line.split()[1:])
        for name in names
    }
    assert found["truth"] == "1.0000005e+06 ± 6.4e+00 -4.50e+99 ± 5.7e+100 0/2"
    assert found[names[1]] == "2.00e+07 1.90e+07 2.00e+07 1/2"  # one run is no interval
    assert found["raw"] == "4.50e+99 ± 5.7e+100 4.50e+99 ± 5.7e+100 0/2"
