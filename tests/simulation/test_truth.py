import copy
from dataclasses import dataclass

import mujoco
import numpy as np
import pytest
from scipy import stats

from estbench.experiment import setup
from estbench.montecarlo import run as experiment
from estbench.randomness import streams
from estbench.robots import backend, parameters
from estbench.robots.controls import ControlRange
from estbench.robots.disturbance import Disturbance
from estbench.robots.layout import state_space
from estbench.robots.library import engine
from estbench.robots.no_return import may_miss
from estbench.scenario.schema import Draw
from estbench.sensors import channel as sensors
from estbench.sensors import timing
from estbench.sensors.clock import Event
from estbench.sensors.delivery import divided
from estbench.sensors.timing import Instant
from estbench.shapes import Array
from estbench.simulation import sources, truth
from estbench.simulation.initial import InitialStates
from estbench.spaces.manifold import Manifold
from tests.helpers import Fleet, random_states, zoo_model

SEED = 7


@dataclass(eq=False)
class Robots:
    """Some runs at their start, and what they were made of."""

    simulator: truth.Simulator
    model: mujoco.MjModel
    space: Manifold
    disturbance: Disturbance
    channels: dict[str, sensors.Channel]
    instants: list[Instant]
    runs: range
    x0: Array


def build(name, kind="additive", density=0.0, runs=range(3), spread=0.1, frame_skip=1, **options):
    """Robots about a random state; `spread` is the initial std."""
    model = zoo_model(name)
    space = state_space(model)
    steps, draws = options.get("steps", 20), options.get("draws", {})
    channels, _ = sensors.build(model, options.get("channels", {}), None, frame_skip)
    dt, timings = model.opt.timestep, [(c.name, c.timing) for c in channels]
    instants = timing.instants(timings, dt, frame_skip, steps * frame_skip * dt)
    mean = random_states(model, 1, seed=1, scale=0.2)[0][0]
    disturbance = Disturbance.build(model, space, kind, density)
    initial = InitialStates(mean, spread * np.eye(space.n))
    simulator = truth.Simulator(
        model, space, channels, timing.Schedule(timings, dt, frame_skip), disturbance, initial,
        draws, len(runs), instants,
    )  # fmt: skip
    simulator.start(np.arange(len(runs)), SEED, runs, np.zeros((len(runs), model.nu)))
    named = {c.name: c for c in channels}
    return Robots(simulator, model, space, disturbance, named, instants, runs, simulator.x)


def wave(model, runs):
    """A controller that differs from run to run and exceeds the actuators' ranges."""
    phase = np.arange(runs)[:, None] + np.arange(model.nu)
    return lambda k, t, x: 1.5 * np.sin(9 * t + phase)


def simulate(robots, controller=None, frame_time=None):
    controller = controller or wave(robots.model, len(robots.runs))
    period = frame_time or robots.model.opt.timestep
    return sources.record(sources.Live(robots.simulator, robots.instants, controller, period))


def set_state(model, data, x):
    data.qpos, data.qvel = x[: model.nq], x[model.nq : model.nq + model.nv]
    data.act = x[model.nq + model.nv :]


def get_state(data):
    return np.concatenate([data.qpos, data.qvel, data.act])


def readings(trajectory):
    """What arrived at each instant: {channel: y `(run, ny)`}."""
    return [{d.channels[0]: d.y for d in divided(arrived)} for arrived in trajectory.deliveries]


def noise(robots):
    """Channel -> the noise of its readings `(reading, run, m)`."""
    count = len(robots.instants)
    return {
        name: c.noise_from(
            streams.normals(SEED, robots.runs, f"sensor:{name}", count, c.space.n), 0.0
        )
        for name, c in robots.channels.items()
    }


# Without noise


@pytest.mark.parametrize("name", ["joints", "activations", "rk4", "contact", "sensors"])
def test_without_noise_the_truth_is_a_loop_of_mj_step(name):
    robots = build(name, frame_skip=2)
    model = robots.model
    trajectory = simulate(robots, frame_time=2 * model.opt.timestep)
    control = wave(model, 3)
    for run in range(3):
        data = mujoco.MjData(model)
        set_state(model, data, robots.x0[run])
        np.testing.assert_array_equal(trajectory.x[0, run], robots.x0[run])
        for k, instant in enumerate(robots.instants):
            u = control(k, instant.start, None)
            np.testing.assert_array_equal(trajectory.u[k], u)
            data.ctrl = ControlRange.of(model).clamp(u)[run]
            mujoco.mj_step(model, data, 2)
            np.testing.assert_array_equal(trajectory.x[k + 1, run], get_state(data))
    assert np.abs(np.diff(trajectory.x, axis=0)).max() > 1e-3  # it moved


@pytest.mark.parametrize("kind", ["force", "actuator"])
def test_readings_are_those_of_the_end_state_without_the_disturbance(kind):
    robots = build("sensors", kind, 0.01)
    model = robots.model
    trajectory, control = simulate(robots), wave(model, 3)
    y, v, data = readings(trajectory), noise(robots), mujoco.MjData(model)
    for k, instant in enumerate(robots.instants):
        for run in range(3):
            set_state(model, data, trajectory.x[k + 1, run])
            data.ctrl = ControlRange.of(model).clamp(control(k, instant.start, None))[run]
            data.time = instant.end
            mujoco.mj_forward(model, data)
            assert list(y[k]) == list(robots.channels)
            for name, channel in robots.channels.items():
                if np.isinf(y[k][name][run]).all():
                    assert may_miss(model, channel.index)
                    continue
                clean = data.sensordata[channel.columns][None]
                expected = channel.space.plus(clean, v[name][k, run][None])[0]
                np.testing.assert_allclose(y[k][name][run], expected, atol=1e-12)


def test_channels_of_different_rate_take_their_noise_in_order():
    slow = {"gyro": sensors.ChannelSection(rate=250 / 3)}
    robots = build("joints", channels=slow, steps=9)
    trajectory = simulate(robots)
    gyro, taken = [robots.channels["gyro"]], 0
    for k, (instant, y) in enumerate(zip(robots.instants, readings(trajectory))):
        assert ("gyro" in instant.channels) == ("gyro" in y) == (k % 3 == 2)
        if "gyro" in y:
            clean = robots.simulator.suite.clean(
                gyro, instant.end, trajectory.x[k + 1], trajectory.u[k]
            )
            np.testing.assert_array_equal(y["gyro"], clean + noise(robots)["gyro"][taken])
            taken += 1
    assert taken == 3


def test_an_instant_without_a_reading():
    slow = {name: sensors.ChannelSection(rate=125) for name in ("touch", "accel")}
    trajectory = simulate(build("contact", channels=slow, steps=8))
    assert [len(y) for y in readings(trajectory)] == [0, 0, 0, 2] * 2


# The disturbance: a correct program fails each with a probability below 1e-6


def one_step(kind, density, runs=4000, frame_skip=5):
    """Change of the end state `(run, n)` caused by the disturbance, the filter's Q, and dt."""
    robots = build("joints", kind, density, range(runs), spread=0.0, frame_skip=frame_skip, steps=1)
    model, space = robots.model, robots.space
    u = np.full((runs, model.nu), 0.3)
    with engine():
        x0, rows = robots.x0[:1], backend.create(model)
        (instant,) = robots.instants
        robots.simulator.advance(Event(instant.tick, instant), u)
        x = robots.simulator.x
        end = rows.step(x0, u[:1], 0.0, frame_skip)
        dt = frame_skip * model.opt.timestep
        Q = robots.disturbance.covariance(rows, space, x0, u[:1], 0.0, dt, frame_skip)
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
    robots = build("joints", "additive", 0.01, range(500))
    process = np.stack([robots.simulator._process.draw().copy() for _ in robots.instants])
    correlation = (process[1:] * process[:-1]).mean()
    assert abs(correlation) < 6 / np.sqrt(process[1:].size)


def test_initial_states_spread_as_p0():
    robots = build("joints", runs=range(3000), spread=0.2, steps=1)
    mean = random_states(robots.model, 1, seed=1, scale=0.2)[0]
    error = robots.space.minus(robots.x0, np.broadcast_to(mean, robots.x0.shape))
    assert_covariance(error, 0.04 * np.eye(robots.space.n))


# Parameters drawn once per run


@pytest.mark.parametrize(
    ("key", "draw"),
    [
        ("body_mass.hand", Draw(relative_std=0.2)),
        ("dof_damping.wrist", Draw(std=0.005)),
        ("body_ipos.arm", Draw(relative_std=0.1, std=0.01)),
    ],
)
def test_each_run_has_its_own_parameter(key, draw):
    robots = build("sensors", draws={key: draw})
    trajectory = simulate(robots)
    nominal = simulate(build("sensors"))
    control, field = wave(robots.model, 3), key.split(".")[0]
    for run in range(3):
        model = copy.copy(zoo_model("sensors"))
        z = streams.normals(SEED, [run], f"parameter:{key}", 1, 1).item()
        index, value = parameters.parameter(model, key, "")[1], getattr(model, field)
        value[index] = value[index] * (1 + draw.relative_std * z) + draw.std * z
        mujoco.mj_setConst(model, mujoco.MjData(model))
        data = mujoco.MjData(model)
        set_state(model, data, robots.x0[run])
        for k, instant in enumerate(robots.instants):
            data.ctrl = ControlRange.of(model).clamp(control(k, instant.start, None))[run]
            mujoco.mj_step(model, data)
            np.testing.assert_array_equal(trajectory.x[k + 1, run], get_state(data))
            sensed = mujoco.MjData(model)
            set_state(model, sensed, trajectory.x[k + 1, run])
            mujoco.mj_forward(model, sensed)
            got = readings(trajectory)[k]["gyro"][run] - noise(robots)["gyro"][k, run]
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
    robots = build("joints", "additive", 1e-3, range(2), steps=3)
    robots.x0[1] = np.nan
    blown = simulate(robots)
    assert np.isfinite(blown.x[:, 0]).all()
    assert np.isnan(blown.x[:, 1]).all()
    assert all(np.isnan(y[1]).all() for arrived in readings(blown) for y in arrived.values())


def test_finite_replaces_whole_rows():
    x = np.array([[1.0, 2.0], [np.nan, 3.0], [np.inf, 4.0]])
    out = sources.finite(x, np.zeros((3, 2)))
    np.testing.assert_array_equal(out, [[1, 2], [0, 0], [0, 0]])


# The controller


def test_the_controller_is_asked_once_a_filter_step_and_sees_the_true_state():
    fast = {"gyro": sensors.ChannelSection(rate=250)}
    robots = build("joints", channels=fast, frame_skip=2, steps=5)
    calls = []

    def control(k, t, x):
        calls.append((k, t, x.copy()))
        return np.full((3, 2), float(k))

    frame = 2 * robots.model.opt.timestep
    trajectory = simulate(robots, control, frame)
    assert [k for k, *_ in calls] == list(range(5))
    np.testing.assert_allclose([t for _, t, _ in calls], frame * np.arange(5))
    np.testing.assert_array_equal([x for *_, x in calls], trajectory.x[0:-1:2])
    np.testing.assert_array_equal(trajectory.u[:, 0, 0], np.repeat(np.arange(5.0), 2))


# Rows that begin at different times


@pytest.mark.parametrize("kind", ["additive", "force", "actuator"])
@pytest.mark.parametrize("timed", [False, True])
def test_rows_that_begin_at_different_times_are_the_runs_alone(kind, timed):
    overrides = [
        f"process_noise={{kind='{kind}', density=0.01, schedule=[[0.04, 1.0], [9.0, 4.0]]}}",
        "channels.gyro={rate=50.0, jitter=0.002, latency_std=0.01}",
        "channels.accel={dropout=0.3, schedule=[[0.03, 1.0], [9.0, 3.0]]}",
        "model.timestep=0.002", "model.frame_skip=5",
        "truth.draw.'body_mass.pole'.relative_std=0.1",
    ]  # fmt: skip
    prepared = setup.build(experiment.resolve("cartpole_imu", duration=0.3, overrides=overrides))
    beginnings = {0: ([0, 1, 2], [0, 1, 2]), 3: ([1], [3]), 5: ([2, 0], [4, 5]), 6: ([1], [0])}

    def followed(fleet):
        """(row, run, ticks since the start, x and what arrives)."""
        for period in range(12):
            fleet.begin(period)
            for event, _, arrived in fleet.period():
                elapsed = event.tick - fleet.simulator.clocks.tick + fleet.simulator.clocks.elapsed
                for row in range(fleet.rows) if event.rows is None else np.flatnonzero(event.rows):
                    said = [fleet.simulator.x[row].tolist()]
                    for d in divided(arrived):
                        if d.mask is None or d.mask[row]:
                            ago = event.tick - d.taken
                            said.append((d.channels[0], ago, d.y[row].tolist()))
                    yield row, int(fleet.runs[row]), int(elapsed[row]), said

    alone = {
        run: {ticks: said for *_, ticks, said in followed(Fleet.alone(prepared, run))}
        for run in range(6)
    }
    compared = 0
    for row, run, ticks, said in followed(Fleet(prepared, 3, beginnings, timed)):
        assert said == alone[run][ticks], f"row {row}, run {run}, tick {ticks}"
        compared += len(said)
    assert compared > 100
