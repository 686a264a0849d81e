"""`process_noise.accelerometer_sees`: the truth, the filter's model and the estimators."""

import mujoco
import numpy as np
import pytest

from estbench.errors import ScenarioError
from estbench.experiment import setup
from estbench.models.seen_noise import DisturbedModel, SeenNoise
from estbench.montecarlo import run as experiment

ROBOT = """<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody><body>
 <joint name="x" type="slide" axis="1 0 0"/><geom size=".1" mass="2"/><site name="imu"/>
 </body></worldbody><actuator><motor name="push" joint="x" gear="3"/></actuator>
 <sensor><accelerometer name="accel" site="imu" noise=".05"/>
 <jointpos name="encoder" joint="x" noise=".02"/></sensor></mujoco>"""
KINDS = ["force", "actuator"]


@pytest.fixture
def robot(tmp_path):
    """A mass that is pushed; without the disturbance its accelerometer reads the control only."""
    path = tmp_path / "robot.xml"
    path.write_text(ROBOT)
    return path


def resolved(robot, kind, *more, sees="disturbance", **options):
    overrides = (f"process_noise.kind={kind}", "process_noise.density=0.02",
                 f"process_noise.accelerometer_sees={sees}", *more)  # fmt: skip
    return experiment.resolve(robot, overrides=overrides, **options)


@pytest.mark.parametrize("kind", KINDS)
def test_the_model_reads_what_mujoco_reads_under_the_force(robot, kind):
    prepared = setup.build(resolved(robot, kind))
    model = prepared.model()
    assert isinstance(model, DisturbedModel)
    assert model.sees_disturbance()
    assert not model.sees_disturbance(["encoder"])
    x, u, d = np.array([[0.1, 0.4], [0.0, -1.0]]), np.zeros((2, 1)), np.array([[0.7], [-0.2]])
    y = model.disturbed_measurement(x, d, u, 0.0, ["accel"])
    data = mujoco.MjData(prepared.shared.robot)
    for row in range(2):
        data.qpos, data.qvel = x[row, :1], x[row, 1:]
        data.qfrc_applied, data.ctrl = (d[row], 0.0) if kind == "force" else (0.0, d[row])
        mujoco.mj_forward(prepared.shared.robot, data)
        np.testing.assert_allclose(y[row], data.sensor("accel").data, rtol=0, atol=1e-13)
    points = model.disturbed_measurement(x[:, None], d[:, None], u, 0.0, ["accel"])
    np.testing.assert_array_equal(points[:, 0], y)
    # The force of one call does not stay for the next.
    calm = model.disturbed_measurement(x, 0 * d, u, 0.0, ["accel"])
    np.testing.assert_array_equal(model.measurement(x, u, 0.0, ["accel"]), calm)


@pytest.mark.parametrize("kind", KINDS)
def test_the_gain_is_a_root_of_the_process_noise(robot, kind):
    model = setup.build(resolved(robot, kind)).model()
    x, u = np.array([[0.1, 0.4]]), np.zeros((1, 1))
    gain, root = model.disturbance_gain(x, u, 0.0, 0.01)
    np.testing.assert_allclose(gain @ gain.mT, model.process_noise(x, u, 0.0, 0.01), rtol=1e-12)
    np.testing.assert_allclose(root @ root.T, [[0.02 / 0.01]], rtol=1e-12)
    Q = SeenNoise(model).process_noise(x, u, 0.0, 0.01)
    assert np.linalg.matrix_rank(Q[0]) == 1


def test_an_accelerometer_that_feels_the_force_knows_the_velocity_better(robot):
    """With it the velocity is the integral of what is read; without, that of the control alone.

    NEES/n over 40 runs of 60 steps has a standard deviation of about 0.1: within 0.5 of 1 it has a
    false-alarm rate below 1e-5.
    """
    rmse = {}
    for sees in ("control", "disturbance"):
        names = ["ekf", "sr_ukf", "rts"]
        scenario = resolved(robot, "force", "initial.std=0.01", sees=sees)
        results = experiment.run(scenario, names, runs=40, duration=0.6)
        for name in names:
            assert results[name].anees.value == pytest.approx(1.0, abs=0.5)
            assert results[name].anis.value == pytest.approx(1.0, abs=0.1)
        rmse[sees] = results["ekf"].rmse[1].value
    assert rmse["disturbance"] < 0.5 * rmse["control"]


@pytest.mark.parametrize("start", ["batch", "static"])
def test_a_start_from_the_first_readings_works_on_the_state_with_the_disturbance(robot, start):
    scenario = resolved(robot, "force", f"start.method={start}", "start.window=0.05")
    results = experiment.run(scenario, ["ekf", "enkf", "imm"], runs=3, duration=0.2)
    assert all(np.isfinite(results[name].anees.value) for name in ("ekf", "enkf", "imm"))


def test_a_disturbance_of_the_state_is_refused(robot):
    with pytest.raises(ScenarioError, match="no sensor feels"):
        setup.build(resolved(robot, "additive"))


def test_it_is_said_where_sensors_are_described(robot):
    assert setup.build(resolved(robot, "force")).sight.startswith("read under the control and dist")
    plain = setup.build(resolved(robot, "force", sees="control"))
    assert plain.sight.endswith(": accel")
    assert "without the disturbance" in plain.sight
