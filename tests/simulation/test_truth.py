import copy

import mujoco
import numpy as np
import pytest
from scipy import stats

from estbench.randomness import streams
from estbench.robots import backend, parameters
from estbench.robots.controls import ControlRange
from estbench.robots.disturbance import Disturbance
from estbench.robots.layout import state_space
from estbench.robots.library import engine
from estbench.scenario.schema import Draw
from estbench.sensors import channel as sensors
from estbench.sensors import timing
from estbench.simulation import truth
from tests.helpers import random_states, zoo_model


def build(name, kind="additive", density=0.0, runs=range(3), spread=0.1, frame_skip=1, **options):
    """A simulator about a random state; `spread` is the initial std."""
    model = zoo_model(name)
    space = state_space(model)
    steps, draws = options.get("steps", 20), options.get("draws", {})
    channels, _ = sensors.build(model, options.get("channels", {}), None, frame_skip)
    dt, timings = model.opt.timestep, [(c.name, c.timing) for c in channels]
    instants = timing.instants(timings, dt, frame_skip, steps * frame_skip * dt)
    mean = random_states(model, 1, seed=1, scale=0.2)[0][0]
    disturbance = Disturbance.build(model, space, kind, density)
    initial = (mean, spread * np.eye(space.n))
    return truth.Simulator(model, space, channels, instants, disturbance, initial, draws, 7, runs)


def wave(model, runs):
    """A controller that differs from run to run and exceeds the actuators' ranges."""
    phase = np.arange(runs)[:, None] + np.arange(model.nu)
    return lambda k, t, x: 1.5 * np.sin(9 * t + phase)


def simulate(simulator, controller=None, frame_time=None):
    runs, model = len(simulator.x0), simulator._model
    frame_time = frame_time or model.opt.timestep
    with engine():
        return truth.simulate(simulator, controller or wave(model, runs), frame_time)


def set_state(model, data, x):
    data.qpos, data.qvel = x[: model.nq], x[model.nq : model.nq + model.nv]
    data.act = x[model.nq + model.nv :]


def get_state(data):
    return np.concatenate([data.qpos, data.qvel, data.act])


def readings(trajectory):
    """What arrived at each instant: {channel: y `(run, ny)`}."""
    return [{d.channel: d.y for d in arrived} for arrived in trajectory.deliveries]


def noise(simulator):
    """Channel -> the noise of its readings `(reading, run, m)`."""
    return {r.channel.name: r._noise for r in simulator._readings}


# Without noise


@pytest.mark.parametrize("name", ["joints", "activations", "rk4", "contact", "sensors"])
def test_without_noise_the_truth_is_a_loop_of_mj_step(name):
    simulator = build(name, frame_skip=2)
    model = simulator._model
    trajectory = simulate(simulator, frame_time=2 * model.opt.timestep)
    control = wave(model, 3)
    for run in range(3):
        data = mujoco.MjData(model)
        set_state(model, data, simulator.x0[run])
        np.testing.assert_array_equal(trajectory.x[0, run], simulator.x0[run])
        for k, instant in enumerate(simulator.instants):
            u = control(k, instant.start, None)
            np.testing.assert_array_equal(trajectory.u[k], u)
            data.ctrl = ControlRange.of(model).clamp(u)[run]
            mujoco.mj_step(model, data, 2)
            np.testing.assert_array_equal(trajectory.x[k + 1, run], get_state(data))
    assert np.abs(np.diff(trajectory.x, axis=0)).max() > 1e-3  # it moved


@pytest.mark.parametrize("kind", ["force", "actuator"])
def test_readings_are_those_of_the_end_state_without_the_disturbance(kind):
    simulator = build("sensors", kind, 0.01)
    model = simulator._model
    trajectory, control = simulate(simulator), wave(model, 3)
    y, v, data = readings(trajectory), noise(simulator), mujoco.MjData(model)
    for k, instant in enumerate(simulator.instants):
        for run in range(3):
            set_state(model, data, trajectory.x[k + 1, run])
            data.ctrl = ControlRange.of(model).clamp(control(k, instant.start, None))[run]
            data.time = instant.end
            mujoco.mj_forward(model, data)
            assert list(y[k]) == list(simulator._channels)
            for name, channel in simulator._channels.items():
                clean = data.sensordata[channel.columns][None]
                expected = channel.space.plus(clean, v[name][k, run][None])[0]
                np.testing.assert_allclose(y[k][name][run], expected, atol=1e-12)


def test_channels_of_different_rate_take_their_noise_in_order():
    slow = {"gyro": sensors.ChannelSection(rate=250 / 3)}
    simulator = build("joints", channels=slow, steps=9)
    trajectory = simulate(simulator)
    gyro, taken = [simulator._channels["gyro"]], 0
    for k, (instant, y) in enumerate(zip(simulator.instants, readings(trajectory))):
        assert ("gyro" in instant.channels) == ("gyro" in y) == (k % 3 == 2)
        if "gyro" in y:
            clean = simulator.clean(gyro, instant.end, trajectory.x[k + 1], trajectory.u[k])
            np.testing.assert_array_equal(y["gyro"], clean + noise(simulator)["gyro"][taken])
            taken += 1
    assert taken == 3


def test_an_instant_without_a_reading():
    slow = {name: sensors.ChannelSection(rate=125) for name in ("touch", "accel")}
    trajectory = simulate(build("contact", channels=slow, steps=8))
    assert [len(y) for y in readings(trajectory)] == [0, 0, 0, 2] * 2


# The disturbance: a correct program fails each with a probability below 1e-6


def one_step(kind, density, runs=4000, frame_skip=5):
    """Change of the end state `(run, n)` caused by the disturbance, the filter's Q, and dt."""
    simulator = build(
        "joints", kind, density, range(runs), spread=0.0, frame_skip=frame_skip, steps=1
    )
    model, space = simulator._model, simulator._space
    u = np.full((runs, model.nu), 0.3)
    with engine():
        x, _ = simulator.step(0, simulator.x0, u)
        x0, rows = simulator.x0[:1], backend.create(model)
        end = rows.step(x0, u[:1], 0.0, frame_skip)
        dt = frame_skip * model.opt.timestep
        Q = simulator._disturbance.covariance(rows, space, x0, u[:1], 0.0, dt, frame_skip)
    return space.minus(x, np.broadcast_to(end, x.shape)), Q.reshape(space.n, space.n), dt


def assert_covariance(sample, Q):
    # An entry of the sample covariance is nearly N(Q_ij, (Q_ii Q_jj + Q_ij²)/count).
    sigma = np.sqrt((np.outer(np.diag(Q), np.diag(Q)) + Q**2) / len(sample))
    assert (np.abs(sample.T @ sample / len(sample) - Q) <= 6.5 * sigma + 1e-15).all()
    assert (np.abs(sample.mean(axis=0)) <= 6.5 * np.sqrt(np.diag(Q) / len(sample)) + 1e-9).all()


def test_additive_noise_has_covariance_density_times_dt():
    density = 1e-4 * np.arange(1, 25)
    sample, Q, dt = one_step("additive", density.tolist()[: state_space(zoo_model("joints")).n])
    np.testing.assert_allclose(Q, np.diag(density[: len(Q)]) * dt)
    assert_covariance(sample, Q)
    nees = (sample**2 / np.diag(Q)).sum(axis=1)
    assert stats.kstest(nees, stats.chi2(len(Q)).cdf).pvalue > 1e-7


@pytest.mark.parametrize(("kind", "density"), [("force", 1e-5), ("actuator", 1e-4)])
def test_spread_of_a_force_is_the_filters_q(kind, density):
    sample, Q, _ = one_step(kind, density)
    assert np.linalg.matrix_rank(Q, tol=1e-9 * np.abs(Q).max()) == (11 if kind == "force" else 2)
    assert_covariance(sample, Q)


def test_a_force_of_density_q_changes_the_velocity_by_q_dt_over_mass_squared():
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><option timestep="0.001" gravity="0 0 0"/><worldbody><body>
        <joint name="slide" type="slide"/><geom size="0.1" mass="2"/></body></worldbody></mujoco>"""
    )
    disturbance = Disturbance.build(model, state_space(model), "force", 0.3)
    dt, white = 0.02, np.random.default_rng(0).standard_normal((20_000, 1))
    x, u, rows = np.zeros((len(white), 2)), np.zeros((len(white), 0)), backend.create(model)
    ends = rows.step(x, u, 0.0, 20, disturbance.sample(white, 0.0, dt))
    Q = disturbance.covariance(rows, state_space(model), x[:1], u[:1], 0.0, dt, 20)[0]
    # The force is held: Q = (q/m²) γ γᵀ/dt with γ = (about dt²/2, dt) by 20 semi-implicit steps.
    gamma = np.array([0.001**2 * 20 * 21 / 2, dt])
    np.testing.assert_allclose(Q, 0.3 / 4 / dt * np.outer(gamma, gamma))
    assert_covariance(ends, Q)


def test_disturbance_is_white_in_time():
    simulator = build("joints", "additive", 0.01, range(500))
    process = simulator._process
    correlation = (process[1:] * process[:-1]).mean()
    assert abs(correlation) < 6 / np.sqrt(process[1:].size)


def test_initial_states_spread_as_p0():
    simulator = build("joints", runs=range(3000), spread=0.2, steps=1)
    mean = random_states(simulator._model, 1, seed=1, scale=0.2)[0]
    error = simulator._space.minus(simulator.x0, np.broadcast_to(mean, simulator.x0.shape))
    assert_covariance(error, 0.04 * np.eye(simulator._space.n))


# Parameters drawn once a run


@pytest.mark.parametrize(
    ("key", "draw"),
    [
        ("body_mass.hand", Draw(relative_std=0.2)),
        ("dof_damping.wrist", Draw(std=0.005)),
        ("body_ipos.arm", Draw(relative_std=0.1, std=0.01)),
    ],
)
def test_each_run_has_its_own_parameter(key, draw):
    simulator = build("sensors", draws={key: draw})
    trajectory = simulate(simulator)
    nominal = simulate(build("sensors"))
    control, field = wave(simulator._model, 3), key.split(".")[0]
    for run in range(3):
        model = copy.copy(zoo_model("sensors"))
        z = streams.normals(7, [run], f"parameter:{key}", 1, 1).item()
        index, value = parameters.parameter(model, key, "")[1], getattr(model, field)
        value[index] = value[index] * (1 + draw.relative_std * z) + draw.std * z
        mujoco.mj_setConst(model, mujoco.MjData(model))
        data = mujoco.MjData(model)
        set_state(model, data, simulator.x0[run])
        for k, instant in enumerate(simulator.instants):
            data.ctrl = ControlRange.of(model).clamp(control(k, instant.start, None))[run]
            mujoco.mj_step(model, data)
            np.testing.assert_array_equal(trajectory.x[k + 1, run], get_state(data))
            sensed = mujoco.MjData(model)
            set_state(model, sensed, trajectory.x[k + 1, run])
            mujoco.mj_forward(model, sensed)
            got = readings(trajectory)[k]["gyro"][run] - noise(simulator)["gyro"][k, run]
            np.testing.assert_allclose(got, sensed.sensor("gyro").data, atol=1e-9)
    assert (np.abs(trajectory.x[-1] - nominal.x[-1]).max(axis=-1) > 1e-9).all()
    np.testing.assert_array_equal(trajectory.x[0], nominal.x[0])


def test_the_nominal_model_keeps_its_parameters():
    before = zoo_model("sensors").body_mass.copy()
    simulate(build("sensors", draws={"body_mass.hand": Draw(relative_std=0.2)}))
    np.testing.assert_array_equal(zoo_model("sensors").body_mass, before)


# A run that blows up


@pytest.mark.parametrize("name", ["joints", "rk4"])
def test_a_run_that_blows_up_is_nan_and_the_others_are_untouched(name):
    model, seen = zoo_model(name), []

    def control(k, t, x):
        seen.append(x.copy())
        u = wave(model, 4)(k, t, x)
        if k >= 5:
            u[2, 1] = 1e15
        return u

    blown = simulate(build(name, "force", 1e-3, range(4)), control)
    calm = simulate(build(name, "force", 1e-3, range(4)))
    failed = ~np.isfinite(blown.x).all(axis=-1)
    first = int(failed[:, 2].argmax())
    assert 6 <= first <= 10
    assert failed[first:, 2].all()  # no silent reset
    assert np.isnan(blown.x[first:, 2]).all()
    late, early = readings(blown), readings(calm)
    assert all(np.isnan(y[2]).all() for arrived in late[first:] for y in arrived.values())
    others = [0, 1, 3]
    np.testing.assert_array_equal(blown.x[:, others], calm.x[:, others])
    for a, b in zip(late, early):
        for name in a | b:
            np.testing.assert_array_equal(a[name][others], b[name][others])
    assert np.isfinite(seen).all()  # the controller never sees the NaN


def test_a_run_that_blew_up_has_no_attitude_either():
    simulator = build("joints", "additive", 1e-3, range(2), steps=3)
    simulator.x0[1] = np.nan
    blown = simulate(simulator)
    assert np.isfinite(blown.x[:, 0]).all()
    assert np.isnan(blown.x[:, 1]).all()
    assert all(np.isnan(y[1]).all() for arrived in readings(blown) for y in arrived.values())


def test_finite_replaces_whole_rows():
    x = np.array([[1.0, 2.0], [np.nan, 3.0], [np.inf, 4.0]])
    out = truth.finite(x, np.zeros((3, 2)))
    np.testing.assert_array_equal(out, [[1, 2], [0, 0], [0, 0]])


# The controller


def test_the_controller_is_asked_once_a_filter_step_and_sees_the_true_state():
    fast = {"gyro": sensors.ChannelSection(rate=250)}
    simulator = build("joints", channels=fast, frame_skip=2, steps=5)
    calls = []

    def control(k, t, x):
        calls.append((k, t, x.copy()))
        return np.full((3, 2), float(k))

    frame = 2 * simulator._model.opt.timestep
    trajectory = simulate(simulator, control, frame)
    assert [k for k, *_ in calls] == list(range(5))
    np.testing.assert_allclose([t for _, t, _ in calls], frame * np.arange(5))
    np.testing.assert_array_equal([x for *_, x in calls], trajectory.x[0:-1:2])
    np.testing.assert_array_equal(trajectory.u[:, 0, 0], np.repeat(np.arange(5.0), 2))
