import numpy as np
import pytest

from estbench.experiment import setup
from estbench.montecarlo import run as experiment
from estbench.scenario.filter import FilterSection
from estbench.sensors.description import HEADINGS, ChannelDescription, describe, numbers


def prepare(*overrides, name="cartpole_imu"):
    return setup.build(experiment.resolve(name, overrides=overrides))


def words(**section):
    settings = ", ".join(f"{k} = {v}" for k, v in section.items())
    prepared = prepare(f"channels.gyro={{{settings}}}")
    channel = next(c for c in prepared.channels if c.name == "gyro")
    return ", ".join(ChannelDescription.of(channel).imperfections)


@pytest.mark.parametrize(
    ("section", "expected"),
    [
        ({}, ""),
        ({"bias": 0.1}, "bias 0.1"),
        ({"bias": "[0.1, 0.2, 0.1]"}, "bias 0.1 0.2"),
        ({"bias_walk": 0.01}, "bias walk 0.01/√s"),
        ({"drift": 0.01, "drift_time": 20}, "drift 0.01 over 20 s"),
        ({"scale_factor": 0.02, "misalignment": 0.01}, "scale factor 2%, misaligned 0.01 rad"),
        ({"student_dof": 5}, "Student-t noise, 5 degrees of freedom"),
        ({"outlier_probability": 0.02}, "2% outliers x 10"),
        ({"cutoff": 3, "quantization": 0.1, "deadband": 0.2},
         "saturates at ± 3, steps of 0.1, deadband 0.2"),
        ({"stuck": 0.01, "stuck_length": 20}, "1% get stuck for 20"),
        ({"dropout": 0.25}, "25% lost"),
        ({"dropout": 0.25, "dropout_length": 4}, "25% lost in gaps of 4"),
        ({"rate": 10, "jitter": 0.02}, "jitter ± 20 ms"),
        ({"rate": 10, "phase": 0.02}, "first reading at 20 ms"),
        ({"rate": 10, "phase": 0.1}, ""),
        ({"schedule": "[[9.0, 2.0]]"}, "noise by schedule"),
        ({"cov": "[[1, 0.5, 0], [0.5, 1, 0], [0, 0, 1]]"}, "correlated noise"),
    ],
)  # fmt: skip
def test_imperfections_in_words(section, expected):
    assert words(**section) == expected


def test_latency_in_words():
    def late(**settings):
        overrides = [f"channels.gyro.{k}={v}" for k, v in settings.items()]
        return ChannelDescription.of(prepare(*overrides).channels[-1]).latency_text

    assert late() == ""
    assert late(latency=0.08) == "80 ms"
    assert late(latency=0.08, latency_std=0.01) == "80 ± 10 ms"


def test_numbers():
    assert numbers(np.array([0.1, 0.1])) == "0.1"
    assert numbers(np.array([0.1, 0.25])) == "0.1 0.25"


def test_a_channel_of_several_sensors_names_the_noise_of_each_unit():
    imu = "channels.imu={of=['accel', 'gyro'], noise=[0.1, 0.2, 0.1, 0.01, 0.01, 0.01]}"
    (description,) = describe(
        [c for c in prepare(imu, name="quadrotor").channels if c.name == "imu"], FilterSection()
    )
    assert description.row()[:4] == ("imu", "accelerometer + gyro", "0.1 0.2, 0.01", "m/s², rad/s")
    assert len(description.row()) == len(HEADINGS)
    assert description.units == ("m/s²",) * 3 + ("rad/s",) * 3
    np.testing.assert_allclose(description.std, [0.1, 0.2, 0.1, 0.01, 0.01, 0.01])


def test_what_the_filter_believes():
    prepared = prepare(
        "channels.gyro={rate=10, jitter=0.02, schedule=[[99.0, 2.0]]}",
        "filter.channels.gyro={noise=0.5, latency=0.1, timestamps='due', follow_schedule=false}",
        "filter.channels.accel.cov=[[1, 0, 0], [0, 1, 0], [0, 0, 1]]",
    )
    found = {c.name: c.belief for c in describe(prepared.channels, prepared.scenario.filter)}
    assert found == {
        "cart_encoder": (),
        "accel": ("another R",),
        "gyro": ("noise σ 0.5", "latency 100 ms", "no jitter", "no schedule"),
    }


def test_times_are_in_seconds():
    settings = "{rate=10, phase=0.02, jitter=0.03, latency=0.08, latency_std=0.01}"
    gyro = prepare(f"channels.gyro={settings}").channels[-1]
    found = ChannelDescription.of(gyro)
    assert found.rate == pytest.approx(10.0)
    given = (found.first, found.jitter, found.latency, found.latency_std)
    assert given == pytest.approx((0.02, 0.03, 0.08, 0.01))
    assert found.summary == "gyro, 10 Hz, 80 ± 10 ms late"
