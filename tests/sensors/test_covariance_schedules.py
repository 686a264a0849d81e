"""R(t) and Q_s(t) as whole matrices from a user's function: drawn, and believed."""

import re
import sys

import gymnasium as gym
import numpy as np
import pytest

import estbench
import estbench.envs
from estbench.commands import cli
from estbench.errors import CovarianceError, ScenarioError
from estbench.experiment import setup
from estbench.montecarlo import run as experiment
from estbench.robots.disturbance import Disturbance
from estbench.robots.library import engine
from estbench.sensors import schedules
from estbench.sensors.delivery import divided
from tests.helpers import simulated
from tests.sensors import test_schedules as factors

HERE, FACTORS = __name__, factors.__name__
IMU = "cartpole_imu"
VELOCITIES = np.diag([0.0, 0.0, 1.0, 1.0])


def R(t):
    """Of a gyro whose axes come to be correlated, and which grows noisier."""
    rho = min(0.9, t)
    return (0.02 + 0.05 * t) ** 2 * np.array([[1, rho, 0], [rho, 1, 0], [0, 0, 4.0]])


def believed_R(t):
    return 0.25 * np.eye(3) * (1 + t)


def Q(t):
    """Calm at first on the cart, then both coordinates are shaken together."""
    late = float(t > 0.5)
    both = np.array([[late, 0.5 * late], [0.5 * late, 2.0]])
    return np.block([[np.zeros((2, 4))], [np.zeros((2, 2)), 0.1 * both]])


def force_Q(t):
    return [[0.3, 0.1], [0.1, 0.2 + t]]


def asymmetric(t):
    return np.eye(3) if t < 0.5 else np.tri(3)


def singular(t):
    return np.ones((3, 3))


def indefinite(t):
    return np.diag([0.0, 0.0, 1.0, 1.0 - 4 * t])


def too_large(t):
    return np.eye(4)


def prepare(*overrides, name=IMU):
    return setup.build(experiment.resolve(name, runs=4, duration=1.0, overrides=overrides))


GYRO = f'channels.gyro.schedule="{HERE}:R"'
BELIEF = f'filter.channels.gyro.schedule="{HERE}:believed_R"'
PROCESS = f'process_noise.schedule="{HERE}:Q"'


# R: the noise that is drawn


def readings(prepared):
    trajectory, simulator = simulated(prepared, 4), prepared.simulator(range(4))
    gyro = [c for c in prepared.channels if c.name == "gyro"]
    places = {instant.tick: k for k, instant in enumerate(prepared.instants)}
    taken = [d for a in trajectory.deliveries for d in divided(a) if d.channels == ("gyro",)]
    at = [places[d.taken] for d in taken]
    ends = [prepared.instants[k].end for k in at]
    with engine():
        clean = [
            simulator.suite.clean(gyro, t, trajectory.x[k + 1], trajectory.u[k])
            for k, t in zip(at, ends)
        ]
    return np.array(ends), np.array([d.y for d in taken]) - np.array(clean)


def test_the_noise_is_that_of_the_white_numbers_under_r_of_the_time():
    t, noise = readings(prepare(GYRO))
    _, white = readings(prepare("channels.gyro.noise=1.0"))  # the same numbers, R = 1
    expected = np.stack([w @ np.linalg.cholesky(R(s)).T for s, w in zip(t, white)])
    assert len(t) == 100
    np.testing.assert_allclose(noise, expected, rtol=0, atol=1e-12)


def test_imperfections_come_on_top():
    plain, biased = (readings(prepare(GYRO, *more))[1] for more in ((), ("channels.gyro.bias=1",)))
    bias = biased - plain
    np.testing.assert_allclose(bias, np.broadcast_to(bias[:1], bias.shape), atol=1e-12)
    assert abs(bias).min() > 0


def test_no_other_noise_is_asked_for_or_assumed():
    text = 'channels.thrust={add={type="jointactfrc", object="cart"}%s}'
    use = 'sensors=["gyro", "cart_encoder", "thrust"]'
    assert any("thrust: no noise given" in n for n in prepare(use, text % "").notices)
    prepared = prepare(use, text % f', schedule="{HERE}:scalar_R"')
    assert not any("thrust" in n for n in prepared.notices)
    (channel,) = [c for c in prepared.channels if c.name == "thrust"]
    np.testing.assert_array_equal(channel.cov, scalar_R(0.0))


def scalar_R(t):
    return [[0.5 + t]]


# R: what the filter believes


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        ((), R),
        (("filter.measurement_noise_scale=3.0",), lambda t: 3.0 * R(t)),
        (("filter.channels.gyro.follow_schedule=false",), lambda t: R(0.0)),
        ((BELIEF,), believed_R),
        ((BELIEF, "filter.measurement_noise_scale=3.0"), lambda t: 3.0 * believed_R(t)),
        (
            ("filter.channels.gyro.schedule=[[0.5, 2.0], [1.0, 3.0]]",
             "filter.channels.gyro.noise=0.1"),
            lambda t: (4.0 if t <= 0.5 else 9.0) * 0.01 * np.eye(3),
        ),
        (
            ("filter.channels.gyro.noise=0.1", "filter.channels.gyro.follow_schedule=false"),
            lambda t: 0.01 * np.eye(3),
        ),
    ],
    ids=["follows", "scaled", "ignorant", "own", "own scaled", "own factors", "own constant"],
)  # fmt: skip
def test_the_filters_r(overrides, expected):
    model = prepare(GYRO, *overrides).model()
    for t in (0.0, 0.3, 0.9):
        np.testing.assert_allclose(model.measurement_noise(t, ["gyro"]), expected(t))
        both = model.measurement_noise(t, ["cart_encoder", "gyro"])
        np.testing.assert_allclose(both[1:, 1:], expected(t))
        assert not both[0, 1:].any()


def test_a_belief_of_its_own_of_a_sensor_without_schedule():
    calm, own = prepare(), prepare(BELIEF)
    np.testing.assert_allclose(own.model().measurement_noise(0.5, ["gyro"]), believed_R(0.5))
    np.testing.assert_array_equal(readings(calm)[1], readings(own)[1])  # the truth is as it was


# Q_s


def test_the_disturbance_has_the_covariance_of_the_time_and_the_filter_knows_it():
    prepared = prepare(PROCESS, "filter.process_noise_scale=9.0", name="cartpole")
    assert prepared.disturbance.rank == 4
    assert not any("assuming" in n for n in prepared.notices)
    x, u = np.tile(prepared.mean, (4, 1)), np.zeros((4, 1))
    for t in (0.0, 0.4, 0.6):
        w = prepared.disturbance.sample(np.eye(4), t, 0.01)  # the columns of a root, as rows
        np.testing.assert_allclose(w.T @ w, Q(t) * 0.01, atol=1e-15)
        believed = prepared.model().process_noise(x, u, t, 0.01)
        np.testing.assert_allclose(believed, 9.0 * Q(t) * 0.01)
        np.testing.assert_allclose(prepared.model().spectral_density(x, u, t), 9.0 * Q(t))


def test_a_force_with_a_matrix_is_that_of_the_constant_matrix():
    force = "process_noise.kind=force"
    over_time = prepare(force, f'process_noise.schedule="{HERE}:force_Q"', name="cartpole")
    x, u = np.tile([0.1, 0.2, 0.0, 0.3], (2, 1)), np.zeros((2, 1))
    with engine():
        for t in (0.0, 0.7):
            constant = prepare(force, f"process_noise.matrix={force_Q(t)}", name="cartpole")
            for name, more in (("process_noise", (0.01,)), ("spectral_density", ())):
                found, expected = (
                    getattr(p.model(), name)(x, u, t, *more) for p in (over_time, constant)
                )
                np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-12)


def test_a_scaled_root_is_a_root_of_the_scaled():
    model = prepare(name="cartpole").plant
    plain = Disturbance.build(model.model, model.space, "additive", 1.0).scheduled(Q)
    root = plain.scaled(4.0).root(0.7)
    np.testing.assert_allclose(root @ root.T, 4.0 * Q(0.7), atol=1e-15)


# All together: the filter that knows R(t) and Q_s(t) is consistent, the one that does not is not


def test_knowing_them_is_being_consistent():
    """100 runs: NEES/n of a consistent filter leaves 1 ± 5 standard errors once in 10^6."""
    noisy = (GYRO, PROCESS)
    ignorant = ("filter.channels.gyro.follow_schedule=false",)
    options = {"runs": 100, "duration": 1.0, "seed": 3}
    knows, guesses = (
        estbench.run(IMU, ["ekf"], overrides=o, **options)["ekf"].anees
        for o in (noisy, noisy + ignorant)
    )
    error = 0.5 * (knows.high - knows.low) / 1.98
    assert abs(knows.value - 1) < 5 * error < 0.2
    assert guesses.low > 1 + 5 * error


# In environments: a batch of robots draws what single ones draw


@pytest.mark.parametrize(
    "overrides",
    [
        [GYRO, PROCESS],
        [f'channels.gyro.schedule="{FACTORS}:per_axis"',
         f'process_noise.schedule="{FACTORS}:per_coordinate"'],
    ],
    ids=["matrices", "factors"],
)  # fmt: skip
def test_rows_of_an_environment_are_single_ones(overrides, tmp_path):
    scenario = experiment.resolve(IMU, overrides=overrides)
    kwargs = {"scenario": scenario, "observe": "raw"}
    vector = gym.make_vec("estbench/CartPole-v0", 3, **kwargs)
    singles = [gym.make("estbench/CartPole-v0", **kwargs) for _ in range(3)]
    assert vector.reset(seed=5)
    for i, env in enumerate(singles):
        env.reset(seed=5 + i)
    for _ in range(5):
        together, *_, info = vector.step(np.zeros((3, 1), np.float32))
        for i, env in enumerate(singles):
            alone, *_, one = env.step(np.zeros(1, np.float32))
            np.testing.assert_array_equal(together[i], alone)
            np.testing.assert_array_equal(info["truth"][i], one["truth"])


# Mistakes


@pytest.mark.parametrize(
    ("symbol", "axes", "function", "error", "message"),
    [
        ("R", 3, singular, CovarianceError, "R must be symmetric positive definite"),
        (
            "R",
            3,
            too_large,
            ScenarioError,
            "expected one positive factor, 3 of them, or R of shape",
        ),
        ("Q_s", 4, indefinite, CovarianceError, "Q_s must be symmetric positive semidefinite"),
    ],
)
def test_what_is_no_covariance(symbol, axes, function, error, message):
    user = schedules.UserFunction(function, axes, "channels.gyro.schedule", symbol)
    with pytest.raises(
        error, match=rf"^channels\.gyro\.schedule returned .* at t = 0\.5 s; .*{message}"
    ):
        user.at(0.5)


def test_one_that_is_wrong_later_is_one_line_that_names_channel_and_time(
    capfd, monkeypatch, tmp_path
):
    monkeypatch.chdir(tmp_path)
    schedule = f'channels.gyro.schedule="{HERE}:asymmetric"'
    command = ["estbench", "run", IMU, "--runs", "2", "--duration", "1", "--set", schedule]
    monkeypatch.setattr(sys, "argv", [*command, "--executor", "threads"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    out, err = capfd.readouterr()
    assert (ended.value.code, out) == (2, "")
    (line,) = err.splitlines()
    assert re.match(
        r"estbench: channels\.gyro\.schedule returned \[\[1\.0, .* at t = 0\.5 s; R must", line
    )
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("overrides", "unused"),
    [
        ((GYRO, "channels.gyro.noise=0.1"), "channels.gyro.noise"),
        ((PROCESS, "process_noise.density=0.1"), "process_noise.density"),
    ],
)
def test_a_constant_beside_a_covariance_over_time_is_said_not_to_be_used(overrides, unused):
    where = unused.rpartition(".")[0]
    said = f"{where}.schedule gives whole covariances: {unused} is not used"
    assert said in prepare(*overrides).notices
    assert not any("is not used" in n for n in prepare().notices)


@pytest.mark.parametrize("schedule", [GYRO, BELIEF])
def test_a_belief_cannot_be_constant_and_follow(schedule):
    with pytest.raises(ScenarioError, match=r"filter\.channels\.gyro has a constant R of its own"):
        prepare(schedule, "filter.channels.gyro.noise=0.1")
