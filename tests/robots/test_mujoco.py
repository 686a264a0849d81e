import mujoco
import numpy as np
import pytest

from estbench.errors import CovarianceError, DimensionError, ScenarioError
from estbench.models.protocol import Model
from estbench.robots import mjcf
from estbench.robots.disturbance import Disturbance
from estbench.robots.layout import sensor_space, state_space
from estbench.robots.model import MujocoModel, SensorChannel
from tests.helpers import CENTERED, ZOO, all_channels, mujoco_model, random_states, zoo_model


@pytest.fixture(autouse=True)
def _log_elsewhere(tmp_path, monkeypatch):
    """MuJoCo writes its warnings of broken rows to MUJOCO_LOG.TXT in the current folder."""
    monkeypatch.chdir(tmp_path)


every_model = pytest.mark.parametrize("name", ZOO)
DISABLE = mujoco.mjtDisableBit


def plain_model(name):
    """As MuJoCo compiles it, without warm starts."""
    model = mujoco.MjModel.from_xml_string(ZOO[name])
    model.opt.disableflags |= DISABLE.mjDSBL_WARMSTART
    return model


def at(model, x, u, t=0.0):
    data = mujoco.MjData(model)
    data.qpos, data.qvel, data.act = np.split(x, [model.nq, model.nq + model.nv])
    data.ctrl, data.time = u, t
    return data


def stepped(model, x, u, k=1, t=0.0):
    data = at(model, x, u, t)
    for _ in range(k):
        mujoco.mj_step(model, data)
    return np.concatenate([data.qpos, data.qvel, data.act])


def read(model, x, u, t=0.0):
    data = at(model, x, u, t)
    mujoco.mj_forward(model, data)
    return data.sensordata.copy()


def centered(function, space, target, x, step=1e-6):
    ends = [[function(space.plus(x, sign * e)) for sign in (1, -1)] for e in step * np.eye(space.n)]
    return np.transpose([target.minus(up, down) for up, down in ends]) / (2 * step)


def assert_close(J, expected, rtol):
    """Against each row's own largest entry, since rows differ in unit by orders of magnitude."""
    scale = np.abs(expected).max(axis=-1, keepdims=True) + 1e-3
    np.testing.assert_allclose(J / scale, expected / scale, rtol=0, atol=rtol)


@every_model
@pytest.mark.parametrize("k", [1, 4])
def test_transition_is_a_loop_of_mj_step(name, k):
    model, plain = mujoco_model(name), plain_model(name)
    x, u = random_states(plain, 5)
    out = model.transition(x, 5 * u, 0.3, k * plain.opt.timestep)
    for i in range(5):
        np.testing.assert_array_equal(out[i], stepped(plain, x[i], 5 * u[i], k, 0.3))
    assert isinstance(model, Model)


@pytest.mark.parametrize("name", ["joints", "activations", "implicitfast"])
def test_transition_jacobian_is_mjd_transition_fd(name):
    model, mj = mujoco_model(name, differences=CENTERED), zoo_model(name)
    x, u = random_states(mj, 3, scale=1.0)
    u = np.clip(u, -1, 1)  # inside the ctrlrange
    _, F = model.transition_jacobian(x, u, 0.0, mj.opt.timestep)
    for i in range(3):
        A = np.empty((model.space.n, model.space.n))
        data = at(mj, x[i], u[i])
        mujoco.mjd_transitionFD(mj, data, 1e-6, True, A, None, None, None)
        np.testing.assert_allclose(F[i], A, atol=1e-7)


@every_model
@pytest.mark.parametrize("k", [1, 3])
def test_transition_jacobian_is_the_slope_of_mj_step(name, k):
    model, plain = mujoco_model(name, differences=CENTERED), plain_model(name)
    space = state_space(plain)
    x, u = random_states(plain, 2, scale=0.01 if name == "contact" else 0.5)
    f, F = model.transition_jacobian(x, u, 0.0, k * plain.opt.timestep)
    for i in range(2):
        np.testing.assert_array_equal(f[i], stepped(plain, x[i], u[i], k))
        expected = centered(lambda p: stepped(plain, p, u[i], k), space, space, x[i])  # noqa: B023
        assert_close(F[i], expected, 1e-7)


@every_model
def test_forward_differences_are_the_default_and_close(name):
    dt = zoo_model(name).opt.timestep
    x, u = random_states(zoo_model(name), 2)
    _, F = mujoco_model(name).transition_jacobian(x, u, 0.0, dt)
    _, G = mujoco_model(name, differences=CENTERED).transition_jacobian(x, u, 0.0, dt)
    assert_close(F, G, 1e-4)
    assert not np.array_equal(F, G)


@every_model
def test_measurement_is_mj_forward_for_all_sensors_and_for_each(name):
    model, plain = mujoco_model(name), plain_model(name)
    x, u = random_states(plain, 6)
    expected = np.array([read(plain, x[i], u[i], 0.7) for i in range(6)])
    np.testing.assert_array_equal(model.measurement(x, u, 0.7), expected)
    for i, channel in enumerate(model.channels):
        start = plain.sensor_adr[i]
        y = model.measurement(x, u, 0.7, [channel.name])
        np.testing.assert_array_equal(y, expected[:, start : start + plain.sensor_dim[i]])


ENERGY = """<mujoco><option>{flag}</option><worldbody><body>
  <joint name="s" type="hinge" axis="0 1 0"/>
  <geom type="capsule" size="0.04" fromto="0 0 0 0.4 0 0"/>
  </body></worldbody><sensor><e_potential name="V"/><e_kinetic name="T"/></sensor></mujoco>"""


@pytest.mark.parametrize("flag", ["", '<flag energy="enable"/>'])
def test_energy_sensors_read_their_own_row(flag):
    mj = mjcf.compile_model(mujoco.MjSpec.from_string(ENERGY.format(flag=flag)))
    noise = Disturbance.build(mj, state_space(mj), "additive")
    model = MujocoModel(mj, all_channels(mj), noise)
    x, u = random_states(mj, 5, scale=1.0)
    expected = [read(mj, *row) for row in zip(x, u)]
    np.testing.assert_allclose(model.measurement(x, u, 0.0), expected, atol=1e-12)


@every_model
def test_measurement_jacobian_is_the_slope_of_mj_forward(name):
    model, plain = mujoco_model(name, differences=CENTERED), plain_model(name)
    space, output = state_space(plain), sensor_space(plain, range(plain.nsensor))
    x, u = random_states(plain, 2, scale=0.1)
    y, H = model.measurement_jacobian(x, u, 0.0)
    for i in range(2):
        np.testing.assert_array_equal(y[i], read(plain, x[i], u[i]))
        expected = centered(lambda p: read(plain, p, u[i]), space, output, x[i])  # noqa: B023
        assert_close(H[i], expected, 1e-7)


def test_an_attitude_sensor_on_the_body_has_the_identity_jacobian():
    # y = q ⊞ v and x = q ⊞ δ in the same body frame; a subtraction of quaternions would give 1/2.
    model = mujoco_model("joints", channels=["attitude"], differences=CENTERED)
    x, u = random_states(model.mjmodel, 2, scale=1.0)
    _, H = model.measurement_jacobian(x, u, 0.0)
    expected = np.zeros((3, model.space.n))
    expected[:, model.space.index("root.rx") :][:, :3] = np.eye(3)
    np.testing.assert_allclose(H, [expected] * 2, atol=1e-8)


def test_channels_select_and_order_readings_noise_and_space():
    mj = zoo_model("sensors")
    channels = [
        SensorChannel(c.name, c.index, (i + 1.0) * c.cov) for i, c in enumerate(all_channels(mj))
    ]
    model = mujoco_model("sensors")
    model = MujocoModel(mj, channels, model.disturbance)
    x, u = random_states(mj, 2)
    names = ["gyro", "framequat", "jointpos"]
    y = model.measurement(x, u, 0.0, names)
    parts = [model.measurement(x, u, 0.0, [name]) for name in names]
    np.testing.assert_array_equal(y, np.concatenate(parts, axis=1))
    output = model.output(names)
    assert (output.nx, output.n) == (8, 7)
    assert output.names[:6] == tuple(f"{s}.{a}" for s in ("gyro", "framequat") for a in "xyz")
    assert output.names[6:] == ("jointpos",)
    assert output.units == ("rad/s",) * 3 + ("rad",) * 4
    scale = [1.0 + [c.name for c in channels].index(name) for name in names]
    expected = 0.01 * np.diag(np.repeat(scale, [3, 3, 1]))
    np.testing.assert_allclose(model.measurement_noise(0.0, names), expected)
    assert model.output().n == sum(len(c.cov) for c in channels)


def test_unknown_channel_and_misfit_R():
    model = mujoco_model("joints")
    with pytest.raises(ScenarioError, match=r"no channel 'gyroo' .did you mean 'gyro'"):
        model.output(["gyroo"])
    for m in (2, 4):
        channel = SensorChannel("a", 2, np.eye(m))
        broken = MujocoModel(zoo_model("joints"), [channel], model.disturbance)
        with pytest.raises(DimensionError, match=rf"R has shape .{m}, {m}.; expected"):
            broken.output()


def test_u_of_another_width():
    model = mujoco_model("joints")
    x, _ = random_states(model.mjmodel, 2)
    with pytest.raises(DimensionError, match="u has 3 controls; expected 2"):
        model.transition(x, np.zeros((2, 3)), 0.0, 0.004)


@pytest.mark.parametrize(("dt", "steps"), [(0.004, 1), (0.012, 3), (0.02, 5), (4.0, 1000)])
def test_steps(dt, steps):
    assert mujoco_model("joints").steps(dt) == steps


@pytest.mark.parametrize("dt", [0.0, -0.004, 0.002, 0.006, 0.0121])
def test_dt_must_be_a_multiple_of_the_timestep(dt):
    message = r"dt = .* s is not a multiple of the timestep 0\.004 s \(nearest: 0\.0"
    with pytest.raises(ScenarioError, match=message):
        mujoco_model("joints").steps(dt)


def bad_states(model):
    """Broken inputs `(x, u)` in rows 1, 3, 4, 6 and 7 of eight."""
    x, u = random_states(model, 8)
    x[1, 0], x[3] = np.nan, np.inf
    x[4, model.nq], x[6, model.nq + 1] = 1e11, -1e200
    x[7, :2] = np.inf, -np.inf
    return x, u, [0, 2, 5]


@every_model
@pytest.mark.parametrize("nthread", [1, 2])
def test_a_broken_row_is_nan_and_leaves_the_others_bit_identical(name, nthread):
    model, dt = mujoco_model(name, nthread=nthread), 2 * zoo_model(name).opt.timestep
    x, u, good = bad_states(model.mjmodel)
    clean, alone = random_states(model.mjmodel, 8, seed=1)[0], mujoco_model(name)
    before = model.transition(clean, u, 0.0, dt)
    out = model.transition(x, u, 0.0, dt)
    np.testing.assert_array_equal(out[good], alone.transition(x[good], u[good], 0.0, dt))
    assert np.isnan(np.delete(out, good, axis=0)).all()
    np.testing.assert_array_equal(model.transition(clean, u, 0.0, dt), before)
    y = model.measurement(x, u, 0.0)
    np.testing.assert_array_equal(y[good], alone.measurement(x[good], u[good], 0.0))
    assert np.isnan(y[[1, 3, 7]]).all()
    x[[3, 7]] = np.nan
    _, F = model.transition_jacobian(x, u, 0.0, dt)
    np.testing.assert_array_equal(F[good], alone.transition_jacobian(x[good], u[good], 0.0, dt)[1])
    assert np.isnan(np.delete(F, good, axis=0)).any(axis=(1, 2)).all()


def test_a_nan_control_is_nan_not_zero():
    model = mujoco_model("activations")
    x, u = random_states(model.mjmodel, 3)
    u[1, 2] = np.nan
    out, y = model.transition(x, u, 0.0, 0.005), model.measurement(x, u, 0.0)
    assert np.isnan(out[1]).all()
    assert np.isnan(y[1]).all()
    assert np.isfinite(out[[0, 2]]).all()
    assert np.isfinite(y[[0, 2]]).all()


@every_model
def test_one_and_two_threads_agree_bit_for_bit(name):
    one, two = (mujoco_model(name, nthread=n) for n in (1, 2))
    dt = 2 * zoo_model(name).opt.timestep
    x, u = random_states(one.mjmodel, 9)
    np.testing.assert_array_equal(one.transition(x, u, 0.0, dt), two.transition(x, u, 0.0, dt))
    for a, b in zip(one.measurement_jacobian(x, u, 0.0), two.measurement_jacobian(x, u, 0.0)):
        np.testing.assert_array_equal(a, b)


POINT = """<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody><body>
  <joint name="s" type="slide" axis="1 0 0"/><geom type="sphere" size="0.1" mass="2"/>
  </body></worldbody>
  <actuator><motor name="m" joint="s" gear="3" ctrlrange="-1 1"/></actuator></mujoco>"""


@pytest.mark.parametrize(("kind", "gain"), [("force", 1.0), ("actuator", 3.0)])
def test_process_noise_of_a_point_mass(kind, gain):
    # Symplectic Euler under a force f held for k steps of h: dv = k h f/m, dq = h² f/m k(k + 1)/2.
    mj = mujoco.MjModel.from_xml_string(POINT)
    mj.opt.disableflags |= DISABLE.mjDSBL_CLAMPCTRL
    model = MujocoModel(mj, [], Disturbance.build(mj, state_space(mj), kind, 0.5))
    x, u = np.zeros((2, 2)), np.array([[0.0], [5.0]])  # the second is clamped before the noise
    for k in (1, 5):
        h, dt = 0.01, 0.01 * k
        g = gain / 2 * np.array([h * h * k * (k + 1) / 2, dt])
        Q = model.process_noise(x, u, 0.0, dt)
        np.testing.assert_allclose(Q, [0.5 / dt * np.outer(g, g)] * 2, rtol=1e-9)


def test_additive_process_noise_is_density_times_dt():
    model = mujoco_model("joints", "additive", {"*.vel": 2.0, "root.w?": 3.0})
    Q = model.process_noise(*random_states(model.mjmodel, 2), 0.0, 0.02)
    names = model.space.names
    expected = [0.04 if s.endswith(".vel") else 0.06 if "root.w" in s else 0 for s in names]
    np.testing.assert_allclose(Q, np.diag(expected))


@pytest.mark.parametrize(("name", "kind"), [("joints", "force"), ("activations", "actuator")])
def test_process_noise_against_monte_carlo(name, kind):
    model, count = mujoco_model(name, kind, 1e-4), 4000
    mj, rng = model.mjmodel, np.random.default_rng(0)
    x, u = random_states(mj, 1)
    k, dt = 3, 3 * mj.opt.timestep
    noise = model.disturbance.sample(rng.standard_normal((count, model.disturbance.rank)), 0.0, dt)
    ends = []
    for w in noise:
        data = at(mj, x[0], u[0] + (w if kind == "actuator" else 0.0))
        data.qfrc_applied = w if kind == "force" else 0.0
        for _ in range(k):
            mujoco.mj_step(mj, data)
        ends.append(np.concatenate([data.qpos, data.qvel, data.act]))
    cov = np.cov(model.space.minus(np.array(ends), model.transition(x, u, 0.0, dt)).T)
    Q = model.process_noise(x, u, 0.0, dt)[0]
    std = np.sqrt(np.diag(Q))
    assert (std > 0).all()
    np.testing.assert_allclose(cov / np.outer(std, std), Q / np.outer(std, std), atol=0.1)


def test_forces_do_not_outlive_the_process_noise():
    model = mujoco_model("joints", "force", 1.0)
    x, u = random_states(model.mjmodel, 12)  # as many rows as the noise of one run needs
    before = model.transition(x, u, 0.0, 0.004)
    model.process_noise(x[:1], u[:1], 0.0, 0.004)
    np.testing.assert_array_equal(model.transition(x, u, 0.0, 0.004), before)


def test_no_noise_is_a_zero_Q_and_a_negative_density_is_refused():
    for kind in ("additive", "force", "actuator"):
        Q = mujoco_model("joints", kind).process_noise(
            *random_states(zoo_model("joints"), 2), 0.0, 0.004
        )
        np.testing.assert_array_equal(Q, np.zeros((22, 22)))
    with pytest.raises(CovarianceError, match=r"negative for swing\.vel: -2"):
        mujoco_model("joints", "force", {"swing.vel": -2.0})
