import numpy as np
import pytest

from estbench.errors import ScenarioError
from estbench.experiment import robot_localization, setup
from estbench.scenario.load import resolve

yaml = pytest.importorskip("yaml", reason="PyYAML comes with development tools")


def read(*overrides):
    prepared = setup.build(resolve("quadrotor", ["ekf"], overrides=overrides))
    text = robot_localization.parameters(prepared, "ekf")
    return prepared, text, yaml.safe_load(text)["ekf_filter_node"]["ros__parameters"]


def test_q_is_the_density_that_the_filter_believes_and_p0_its_prior():
    prepared, text, given = read("filter.process_noise_scale=4")
    Q = np.array(given["process_noise_covariance"]).reshape(15, 15)
    model = prepared.model(believed=prepared.believed["ekf"])
    dt = prepared.plant.period
    (believed,) = model.process_noise(prepared.mean[None], prepared.plant.u0[None], 0.0, dt)
    np.testing.assert_allclose(Q[:12, :12], believed / dt, rtol=1e-4, atol=1e-14)
    plain = np.array(read()[2]["process_noise_covariance"]).reshape(15, 15)
    np.testing.assert_allclose(Q[:12, :12], 4.0 * plain[:12, :12], rtol=1e-4)
    P = np.array(given["initial_estimate_covariance"]).reshape(15, 15)
    np.testing.assert_allclose(P[:12, :12], prepared.cov, rtol=1e-4)
    assert isinstance(given["frequency"], float)
    assert given["frequency"] == pytest.approx(1.0 / dt)
    # ROS 2 refuses a list of doubles with an integer in it.
    assert {type(x) for x in given["process_noise_covariance"]} == {float}
    assert "# gyro: angular_velocity_covariance: [" in text


def test_a_robot_without_a_floating_base_or_an_unknown_label():
    with pytest.raises(ScenarioError, match="'cartpole' has no free joint"):
        robot_localization.parameters(setup.build(resolve("cartpole", ["ekf"])), "ekf")
    with pytest.raises(ScenarioError, match="no estimator 'efk'"):
        robot_localization.parameters(setup.build(resolve("cartpole", ["ekf"])), "efk")
