import re
from typing import Any

import numpy as np
import pytest

from estbench.errors import ScenarioError
from estbench.experiment import setup
from estbench.montecarlo import run as experiment
from estbench.robots.library import engine
from estbench.sensors import schedules
from estbench.sensors.delivery import divided
from tests.helpers import simulated

HERE = __name__


def grows(t):
    return 1.0 + t


def per_axis(t):
    return np.array([1.0, 2.0, 3.0 + t])


def per_coordinate(t):
    return [1.0, 1.0, 4.0, 1.0 + t]


def raises(t):
    raise KeyError("calm")


def negative(t):
    return -1.0


def too_many(t):
    return [1.0, 2.0]


def prepare(*overrides, name="cartpole"):
    return setup.build(experiment.resolve(name, runs=4, duration=1.0, overrides=overrides))


def build(*arguments) -> Any:
    return schedules.build(*arguments)


# A table


def test_a_piece_includes_its_end():
    table = build([(1.0, 2.0), (3.0, 5.0)], 1, 3.0, "s")
    assert [table.at(t) for t in (0.0, 0.5, 1.0, 1.001, 3.0)] == [2.0, 2.0, 2.0, 5.0, 5.0]


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([(1.0, 2.0)], r"s ends at 1 s but the run at 3 s; extend its last row"),
        ([(2.0, 1.0), (2.0, 3.0)], r"s: the times \(2\.0, 2\.0\) do not increase"),
    ],
)
def test_bad_tables(rows, message):
    with pytest.raises(ScenarioError, match=message):
        build(rows, 1, 3.0, "s")


# A function


def test_a_function_gives_one_factor_or_one_an_axis():
    assert build(f"{HERE}:grows", 3, 9.0, "s").at(0.5) == 1.5
    np.testing.assert_array_equal(build(f"{HERE}:per_axis", 3, 9.0, "s").at(1.0), [1, 2, 4])


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("grows", "s is 'grows'; use 'module:function'"),
        ("no.such:f", "s: cannot import 'no.such'"),
        (f"{HERE}:grow", "has no function 'grow' (did you mean 'grows'"),
        (f"{HERE}:raises", "s raised at t = 0 s: KeyError: 'calm'"),
        (
            f"{HERE}:negative",
            "s returned -1.0 at t = 0 s; expected one positive factor, 3 of them, or R of",
        ),
        (f"{HERE}:too_many", "s returned [1.0, 2.0] at t = 0 s"),
    ],
)
def test_bad_functions(target, message):
    with pytest.raises(ScenarioError, match=re.escape(message)):
        build(target, 3, 9.0, "s")


# R over time: the noise that is drawn, and the R that the filter believes


@pytest.mark.parametrize(
    ("schedule", "factors"),
    [
        ("[[0.5, 2.0], [1.0, 6.0]]", lambda t: [2.0] * 3 if t <= 0.5 + 1e-9 else [6.0] * 3),
        (f"{HERE}:per_axis", per_axis),
    ],
)
def test_noise_and_its_r_follow_the_schedule(schedule, factors):
    gyro = "channels.gyro.schedule=" + (schedule if schedule[0] == "[" else f'"{schedule}"')
    same = 'control.observe="truth"'  # with "reference" the controls depend on the noise
    noisy, calm = (prepare(*more, same, name="cartpole_imu") for more in ([gyro], []))
    readings = []
    for prepared in (noisy, calm):
        trajectory = simulated(prepared, 4)
        readings.append(
            [d.y for a in trajectory.deliveries for d in divided(a) if d.channels == ("gyro",)]
        )
    x, simulator = trajectory.x, calm.simulator(range(4))
    gyro = [c for c in calm.channels if c.name == "gyro"]
    R = calm.model().measurement_noise(0.0, ["gyro"])
    for k in (0, 49, 50, 99):
        t = calm.instants[k].end
        with engine():
            clean = simulator.suite.clean(gyro, t, x[k + 1], trajectory.u[k])
        np.testing.assert_allclose(
            readings[0][k] - clean, (readings[1][k] - clean) * factors(t), atol=1e-12
        )
        believed = noisy.model().measurement_noise(t, ["gyro"])
        np.testing.assert_allclose(believed, np.outer(factors(t), factors(t)) * R)
        both = noisy.model().measurement_noise(t, ["cart_encoder", "gyro"])
        np.testing.assert_allclose(both[1:, 1:], believed)
        assert both[0, 0] == calm.model().measurement_noise(t, ["cart_encoder"])[0, 0]


def test_the_filter_need_not_know_the_schedule():
    settings = ("channels.cart_encoder.schedule=[[9.0, 3.0]]",)
    ignorant = (*settings, "filter.channels.cart_encoder.follow_schedule=false")
    R = [prepare(*s).model().measurement_noise(0.5, ["cart_encoder"]) for s in (settings, ignorant)]
    np.testing.assert_allclose(R, [[[9e-4]], [[1e-4]]])


@pytest.mark.parametrize(
    ("overrides", "factors"),
    [
        ((), [1.0] * 3),
        (("channels.gyro.schedule=[[9.0, 3.0]]",), [3.0] * 3),
        ((f'channels.gyro.schedule="{HERE}:per_axis"',), per_axis(0.5)),
        (("filter.channels.gyro.schedule=[[9.0, 3.0]]",), [3.0] * 3),
        (("filter.channels.gyro.noise=0.2",), [0.2 / 0.02] * 3),
    ],
    ids=["constant", "factor", "factors", "own factor", "own noise"],
)
def test_the_scale_of_the_filters_r_is_that_of_the_variance(overrides, factors):
    common = ("channels.gyro.noise=0.02", *overrides)
    one, scaled = (
        prepare(*common, *more, name="cartpole_imu").model().measurement_noise(0.5, ["gyro"])
        for more in ((), ("filter.measurement_noise_scale=5.0",))
    )
    np.testing.assert_allclose(one, np.diag((0.02 * np.array(factors)) ** 2), rtol=1e-12)
    np.testing.assert_allclose(scaled, 5.0 * one, rtol=1e-12)


# Q over time


@pytest.mark.parametrize(
    ("schedule", "factors"),
    [
        ("[[0.5, 2.0], [1.0, 6.0]]", lambda t: [2.0] * 4 if t <= 0.5 + 1e-9 else [6.0] * 4),
        (f"{HERE}:per_coordinate", per_coordinate),
    ],
)
def test_the_disturbance_and_its_q_follow_the_schedule(schedule, factors):
    setting = schedule if schedule[0] == "[" else f'"{schedule}"'
    matrix = [[0.0] * 4] * 2 + [[0, 0, 0.02, 0.01], [0, 0, 0.01, 0.03]]
    common = f"process_noise.matrix={matrix}"
    gusty, calm = prepare(common, f"process_noise.schedule={setting}"), prepare(common)
    white = np.random.default_rng(0).standard_normal((4, calm.disturbance.rank))
    x, u = np.tile(calm.mean, (4, 1)), np.zeros((4, 1))
    for t in (0.0, 0.5, 0.51, 0.9):
        f = np.array(factors(t))
        w, w0 = (p.disturbance.sample(white, t, 0.01) for p in (gusty, calm))
        np.testing.assert_allclose(w, w0 * np.sqrt(f))
        Q, Q0 = (p.model().process_noise(x, u, t, 0.01) for p in (gusty, calm))
        np.testing.assert_allclose(Q, Q0 * np.sqrt(np.outer(f, f)))


@pytest.mark.parametrize("kind", ["force", "actuator"])
def test_the_filters_q_of_a_scheduled_force_is_its_response(kind):
    common = (f"process_noise.kind={kind}", "process_noise.density=0.1")
    gusty = prepare(*common, "process_noise.schedule=[[0.5, 4.0], [1.0, 9.0]]").model()
    calm = prepare(*common).model()
    x, u = np.tile([0.1, 0.2, 0.0, 0.3], (2, 1)), np.zeros((2, 1))
    with engine():
        Q0 = calm.process_noise(x, u, 0.0, 0.01)
        for t, f in ((0.2, 4.0), (0.8, 9.0)):
            np.testing.assert_allclose(gusty.process_noise(x, u, t, 0.01), f * Q0, rtol=1e-4)
