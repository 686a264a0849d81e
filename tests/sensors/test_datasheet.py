import numpy as np
import pytest

from estbench.errors import CovarianceError, DimensionError, EstbenchError, ScenarioError
from estbench.experiment import setup
from estbench.montecarlo.run import resolve
from estbench.scenario.channels import ChannelSection
from estbench.sensors import channel as sensors
from estbench.sensors import datasheet
from tests.helpers import zoo_model


def channel(name, **section):
    model = zoo_model("joints")  # 4 ms steps
    (built,), _ = sensors.build(model, {name: ChannelSection(**section)}, [name], 1)
    return built


def part(name, **section):
    made = channel(name, **section).imperfections
    assert made is not None
    return made


# Figures of datasheets


def test_a_noise_density_is_white_noise_of_the_rates_bandwidth():
    """Bias of the mean over 1 s: the density, whatever the rate."""
    for rate in (250.0, 125.0, 25.0):
        R = channel("gyro", noise_density=0.01, rate=rate).cov
        np.testing.assert_allclose(R, 0.01**2 * rate * np.eye(3))
        np.testing.assert_allclose(R / rate, 1e-4 * np.eye(3))


def test_bias_instability_is_a_drift_whose_allan_peak_is_its_floor():
    drift = part("gyro", bias_instability=0.001, drift_time=50.0)
    np.testing.assert_allclose(drift.drift * datasheet.ALLAN_PEAK, 0.001 * datasheet.ALLAN_FLOOR)
    assert drift.drift_time == 50.0
    assert pytest.approx(np.sqrt(2 * np.log(2) / np.pi), abs=1e-4) == datasheet.ALLAN_FLOOR


def test_the_peak_of_a_gauss_markov_drifts_allan_deviation():
    """σ²(τ) = 2 σ² T/τ (1 - T/2τ (3 - 4 exp(-τ/T) + exp(-2τ/T))) for T = σ = 1."""
    tau = np.geomspace(0.1, 100, 100_000)
    square = 2 / tau * (1 - (3 - 4 * np.exp(-tau) + np.exp(-2 * tau)) / (2 * tau))
    assert np.sqrt(square.max()) == pytest.approx(datasheet.ALLAN_PEAK, abs=1e-4)
    assert tau[square.argmax()] == pytest.approx(1.89, abs=0.01)


def test_counts_per_revolution_are_a_quantization_step():
    model = zoo_model("sensors")
    section = ChannelSection(counts_per_revolution=4096)
    (encoder,), _ = sensors.build(model, {"jointpos": section}, ["jointpos"], 1)
    assert encoder.imperfections is not None
    np.testing.assert_allclose(encoder.imperfections.quantization, 2 * np.pi / 4096)


def test_figures_are_one_or_one_an_axis():
    made = part("gyro", bias=0.1, bias_walk=[0.1, 0.2, 0.3])
    np.testing.assert_array_equal(made.bias, [0.1] * 3)
    np.testing.assert_array_equal(made.walk, [0.1, 0.2, 0.3])


def test_white_noise_alone_is_no_imperfection():
    assert channel("gyro", noise=0.1).imperfections is None
    assert channel("gyro", cutoff=9.0).imperfections is not None


def test_the_mjcf_cutoff_is_the_default_saturation(tmp_path):
    text = """<mujoco><worldbody><body><joint name="j"/><geom name="g" size="0.1" mass="1"/>
    <site name="s"/></body><geom name="floor" type="plane" size="1 1 1" pos="0 0 -1"/></worldbody>
    <sensor><jointpos name="a" joint="j" cutoff="2"/><jointpos name="b" joint="j"/>
    <distance name="d" geom1="g" geom2="floor" cutoff="7"/></sensor></mujoco>"""
    (tmp_path / "m.xml").write_text(text)

    def limits(*overrides):
        built = setup.build(resolve(tmp_path / "m.xml", overrides=overrides))
        parts = [c.imperfections for c in built.channels]
        # MuJoCo itself no longer clips the true reading: noise comes first.
        assert built.plant.model.sensor_cutoff.tolist() == [0, 0, 7]
        return [None if p is None else p.cutoff.tolist() for p in parts]

    assert limits() == [[2.0], None, None]  # the cutoff of a distance sensor is how far it looks
    assert limits("channels.a.cutoff=3", "channels.b.cutoff=4") == [[3.0], [4.0], None]


# What cannot be


@pytest.mark.parametrize(
    ("name", "section", "error", "message"),
    [
        ("gyro", {"noise": 0.1, "cov": [[1]]}, ScenarioError, "gyro has noise and cov; give one"),
        ("gyro", {"noise": 0.1, "noise_density": 1}, ScenarioError, "noise and noise_density"),
        ("gyro", {"drift": 0.1, "bias_instability": 1}, ScenarioError, "drift and bias_instab"),
        ("gyro", {"bias": [0.1, 0.2]}, DimensionError, "gyro.bias has 2 values; expected 1 or 3"),
        ("gyro", {"counts_per_revolution": 9}, ScenarioError, "is for angles, not rad/s; use quan"),
        ("lift_encoder", {"misalignment": 0.1}, ScenarioError, "needs a three-axis sensor; .* 1"),
        ("attitude", {"quantization": 0.1}, ScenarioError, "has no meaning for a quaternion"),
        ("attitude", {"cutoff": 1}, ScenarioError, "cutoff has no meaning for a quaternion"),
        ("attitude", {"counts_per_revolution": 9}, ScenarioError, "no meaning for a quaternion"),
        ("gyro", {"dropout": 0.9, "dropout_length": 5.0}, ScenarioError,
         "dropout_length is 5 readings, too short for gaps that lose 0.9 of them; use at least 9"),
        ("gyro", {"jitter": 0.001}, ScenarioError, r"jitter is 0.001 s, less than the timestep"),
        ("gyro", {"noise": 0}, CovarianceError, r"or 0 with filter\.channels\.gyro\.noise"),
    ],
)  # fmt: skip
def test_what_contradicts_itself(name, section, error, message):
    with pytest.raises(error, match=message):
        channel(name, **section)


BAD = [
    ("channels.pole_encoder.bias=-0.1", r"pole_encoder.bias: .*greater than or equal to 0, got -0"),
    ("channels.pole_encoder.bias=[0.1, -1]", r"bias: Input should be .* 0, got \[0\.1, -1\.0\]$"),
    ("channels.pole_encoder.noise=-0.1", r"noise is -0\.1; R must be positive definite"),
    ("channels.pole_encoder.noise_density=-1", r"noise_density: .*greater than 0, got -1"),
    ("channels.pole_encoder.latency_std=-1", r"latency_std: .*got -1"),
    ("channels.pole_encoder.dropout=1.5", r"channels\.pole_encoder\.dropout: .*less than 1, got 1"),
    ("channels.pole_encoder.dropout=-0.1", r"dropout: .*equal to 0, got -0\.1"),
    ("channels.pole_encoder.outlier_probability=2", r"outlier_probability: .*got 2"),
    ("channels.pole_encoder.stuck=1", r"stuck: .*less than 1, got 1"),
    ("channels.pole_encoder.student_dof=2", r"student_dof: .*greater than 2, got 2"),
    ("channels.pole_encodr.rate=9", r"no sensor 'pole_encodr' \(did you mean 'pole_encoder'"),
    ("filter.channels.pole_encodr.noise=9", r"filter\.channels: no channel 'pole_encodr' \(did"),
    ("channels.pole_encoder.cov=[[1, 0], [0, 1]]", r"cov has shape \(2, 2\); expected \(1, 1\)"),
    ("channels.pole_encoder.cov=[[-1]]", r"cov \(R\) is not symmetric positive definite"),
    (
        "filter.channels.pole_encoder.cov=[[1, 0], [0, 1]]",
        r"^filter\.channels\.pole_encoder\.cov h",
    ),
    ("filter.channels.pole_encoder.noise=0", r"^filter\.channels\.pole_encoder\.noise is 0; R m"),
    ("channels.pole_encoder.schedule=[[1, 2.0]]", r"schedule ends at 1 s but the run at 5 s; ext"),
    ("channels.pole_encoder.schedule=[[9, -2.0]]", r"schedule.*1: .*greater than 0, got -2"),
    ("channels.pole_encoder.schedule=[]", r"schedule"),
    ("channels.pole_encoder.schedule=calm", r"schedule is 'calm'; use 'module:function'"),
    ("process_noise.schedule=[[1, 2.0]]", r"process_noise\.schedule ends at 1 s but the run at 5"),
    ("filter.delays=late", r"filter\.delays: .*'exact' or 'naive', got 'late'"),
]


@pytest.mark.parametrize(("override", "message"), BAD)
def test_bad_input_is_one_line(override, message):
    with pytest.raises(EstbenchError, match=message) as error:
        setup.build(resolve("cartpole", overrides=[override]))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("filter.window=0.05", "channels.pole_encoder.latency=0.08"),
         r"filter\.window is 0\.05 s but channel 'pole_encoder' is 0\.08 s late: .*raise the win"),
        (("filter.window=0.05", "filter.channels.pole_encoder.latency=0.08"), r"is 0\.08 s late"),
        (("channels.pole_encoder.jitter=0.02", "channels.pole_encoder.rate=25"),
         r"jitter is 0\.02 s; it must be less than half the period 0\.04 s"),
        (("estimators.ekf={delays='later'}",), r"ekf: delays is 'later'; use 'exact' or 'naive'"),
    ],
)  # fmt: skip
def test_times_that_do_not_fit(overrides, message):
    with pytest.raises(EstbenchError, match=message):
        setup.build(resolve("cartpole", overrides=overrides))


def test_a_window_that_is_too_short_does_not_matter_to_naive_handling():
    overrides = ["filter.window=0.05", "channels.pole_encoder.latency=0.08", "filter.delays=naive"]
    setup.build(resolve("cartpole", overrides=overrides))
