import mujoco
import numpy as np
import pytest
from scipy import stats

from estbench.errors import CovarianceError, DimensionError, ScenarioError
from estbench.scenario.channels import ChannelSection
from estbench.scenario.filter import BelievedChannelSection
from estbench.sensors import channel as sensors
from estbench.sensors.timing import MjcfTiming, Timing, instants
from tests.helpers import at_zero, zoo_model

FULL_R = [[0.04, 0.01, 0.0], [0.01, 0.09, 0.02], [0.0, 0.02, 0.05]]


def build(use=None, frame_skip=1, model=None, **sections):
    model = zoo_model("joints") if model is None else model
    given = {name: ChannelSection(**section) for name, section in sections.items()}
    return sensors.build(model, given, use, frame_skip)


def channel(name, **section):
    channels, _ = build([name], 1, None, **({name: section} if section else {}))
    assert [c.name for c in channels] == [name]
    return channels[0]


def model_with(text):
    body = """<body><joint name="hinge" type="hinge"/><joint name="slide" type="slide"/>
              <geom size="0.1"/></body>"""
    return mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{body}</worldbody><sensor>{text}</sensor></mujoco>"
    )


# Noise: each test refuses a correct program with a probability below 1e-6.


def test_noise_of_a_full_r_is_normal_with_that_covariance():
    gyro = channel("gyro", cov=FULL_R)
    np.testing.assert_array_equal(gyro.cov, FULL_R)
    noise = at_zero(gyro, 1, range(20), 500)
    assert noise.shape == (500, 20, 3)
    flat = noise.reshape(-1, 3)
    d2 = np.einsum("ij,jk,ik->i", flat, np.linalg.inv(FULL_R), flat)
    total = stats.chi2(3 * len(flat))
    assert total.ppf(2.5e-8) < d2.sum() < total.ppf(1 - 2.5e-8)
    assert stats.kstest(d2, stats.chi2(3).cdf).pvalue > 1e-7
    # Each entry of the sample covariance is N(R_ij, (R_ii R_jj + R_ij²)/count) nearly.
    R = np.array(FULL_R)
    sigma = np.sqrt((np.outer(np.diag(R), np.diag(R)) + R**2) / len(flat))
    assert (np.abs(flat.T @ flat / len(flat) - R) < 6 * sigma).all()


def test_noise_is_white_in_time():
    noise = at_zero(channel("lift_encoder", noise=1.0), 2, range(10), 2000)[..., 0]
    lag_one = (noise[1:] * noise[:-1]).mean()
    assert abs(lag_one) < 6 / np.sqrt(noise[1:].size)


@pytest.mark.parametrize(("noise", "expected"), [(0.3, [0.3] * 3), ([0.1, 0.2, 0.3],) * 2])
def test_noise_is_one_std_or_one_an_axis(noise, expected):
    np.testing.assert_allclose(channel("gyro", noise=noise).cov, np.diag(expected) ** 2)


def test_a_quaternion_has_three_axes_of_noise():
    attitude = channel("attitude", noise=[0.1, 0.2, 0.3])
    assert attitude.cov.shape == (3, 3)
    assert (attitude.space.nx, len(attitude.columns)) == (4, 4)


def test_the_mjcf_noise_is_the_default_and_the_scenario_wins():
    model = model_with('<jointpos name="a" joint="hinge" noise="0.25"/>')
    channels, notices = build(model=model)
    assert channels[0].cov == 0.25**2
    assert notices == []
    assert build(model=model, a={"noise": 0.5})[0][0].cov == 0.5**2


def test_a_sensor_without_noise_gets_one_by_its_unit_and_a_notice():
    model = model_with(
        '<jointpos name="a" joint="hinge"/><jointvel name="v" joint="slide"/><e_kinetic name="e"/>'
        '<jointpos name="known" joint="slide" noise="0.5"/>'
    )
    channels, notices = build(model=model, e={}, v={"rate": 500})
    assert [float(np.sqrt(c.cov[0, 0])) for c in channels] == pytest.approx([0.01, 0.02, 0.01, 0.5])
    assert notices == ["no noise given; assuming 0.01 rad (a), 0.02 m/s (v), 0.01 J (e)"]


# Which sensors


def test_all_enabled_sensors_in_the_models_order():
    channels, _ = build(gyro={"enabled": False})
    assert [c.name for c in channels] == ["lift_encoder", "wrist_quat", "attitude"]
    chosen, _ = build(["gyro", "attitude"])
    assert [c.name for c in chosen] == ["attitude", "gyro"]


def test_columns_are_where_the_reading_stands():
    model = zoo_model("joints")
    for c in build()[0]:
        start, width = model.sensor(c.name).adr[0], model.sensor(c.name).dim[0]
        assert c.columns.tolist() == list(range(start, start + width))


@pytest.mark.parametrize(
    ("use", "error", "message"),
    [
        (["gyrro"], ScenarioError, r"sensors: no sensor 'gyrro' \(did you mean 'gyro'\?\)"),
        ([], ScenarioError, "no sensor: the MJCF declares none in use"),
    ],
)
def test_a_bad_choice(use, error, message):
    with pytest.raises(error, match=message):
        build(use)


@pytest.mark.parametrize(
    ("section", "error", "message"),
    [
        ({"noise": -0.1}, CovarianceError, r"channels\.gyro\.noise is -0\.1; .* a std above 0"),
        ({"noise": [1, 0, 1]}, CovarianceError, r"channels\.gyro\.noise is 0;"),
        ({"noise": [1, 1]}, DimensionError, r"gyro\.noise has 2 values; expected 1 or 3"),
        ({"noise": []}, DimensionError, r"gyro\.noise has 0 values"),
        ({"cov": [[1]]}, DimensionError, r"gyro\.cov has shape \(1, 1\); expected \(3, 3\)"),
        ({"cov": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, CovarianceError, r"gyro\.cov \(R\)"),
        ({"cov": [[1, 0.5, 0], [0, 1, 0], [0, 0, 1]]}, CovarianceError, "not symmetric positive"),
        (
            {"rate": 100},
            ScenarioError,
            r"gyro\.rate is 100 Hz, a reading every 2\.5 .* steps of 0\.004 s; .* 83\.3+ or 125 Hz",
        ),
        ({"rate": 1000}, ScenarioError, r"gyro\.rate is 1000 Hz, .* every 0\.25 .* use 250 Hz, or"),
    ],
)
def test_bad_channels(section, error, message):
    with pytest.raises(error, match=message):
        build(gyro=section)


def test_a_section_for_a_sensor_that_is_not_there():
    with pytest.raises(ScenarioError, match=r"channels: no sensor 'gyr' \(did you mean 'gyro'"):
        build(gyr={})


def test_all_sensors_disabled():
    with pytest.raises(ScenarioError, match="no sensor: "):
        build(["gyro"], gyro={"enabled": False})


def test_a_model_without_sensors():
    with pytest.raises(ScenarioError, match=r"add = \{type = 'jointpos'"):
        build(model=model_with(""))


# When each delivers


def schedule(periods, frame_skip=1, duration=0.05, timestep=0.005):
    channels = [(f"p{p}", Timing(p, timestep=timestep)) for p in periods]
    return instants(channels, timestep, frame_skip, duration)


def test_rate_becomes_a_period_of_physics_steps():
    assert channel("gyro", rate=250).timing.period == 1  # timestep 4 ms
    assert channel("gyro", rate=25).timing.period == 10
    assert build(["gyro"], frame_skip=3)[0][0].timing.period == 3


def test_multi_rate_schedule_by_hand():
    # 5 ms steps, a filter step of 2 of them; channels every 1, 2 and 3 steps; 6 steps in all.
    found = schedule([1, 2, 3], frame_skip=2, duration=0.03)
    assert [i.channels for i in found] == [
        ("p1",), ("p1", "p2"), ("p1", "p3"), ("p1", "p2"), ("p1",), ("p1", "p2", "p3"),
    ]  # fmt: skip
    assert [i.control for i in found] == [True, False] * 3
    assert [i.nstep for i in found] == [1] * 6


def test_a_slow_channel_leaves_instants_without_a_reading():
    found = schedule([4], frame_skip=2, duration=0.04)
    assert [i.channels for i in found] == [(), ("p4",), (), ("p4",)]
    assert [i.nstep for i in found] == [2] * 4
    assert all(i.control for i in found)


def test_a_rate_that_does_not_fit_the_filter_step_splits_it():
    found = schedule([3], frame_skip=2, duration=0.03)
    assert [(round(i.end / 0.005), i.nstep, i.channels, i.control) for i in found] == [
        (2, 2, (), True),
        (3, 1, ("p3",), True),
        (4, 1, (), False),
        (6, 2, ("p3",), True),
    ]


@pytest.mark.parametrize("periods", [[1], [3, 7], [2, 5]])
@pytest.mark.parametrize("frame_skip", [1, 2, 3])
def test_instants_join_and_every_reading_is_on_time(periods, frame_skip):
    found = schedule(periods, frame_skip, 0.5)
    ticks = [round(i.end / 0.005) for i in found]
    assert found[0].start == 0.0
    assert [i.tick for i in found] == ticks
    assert [i.start for i in found[1:]] == [i.end for i in found[:-1]]
    assert np.cumsum([i.nstep for i in found]).tolist() == ticks
    assert ticks[-1] == round(100 / frame_skip) * frame_skip
    for period in periods:
        delivered = [t for t, i in zip(ticks, found) if f"p{period}" in i.channels]
        assert delivered == list(range(period, ticks[-1] + 1, period))
    asked = [round(i.start / 0.005) for i in found if i.control]
    assert asked == list(range(0, ticks[-1], frame_skip))


@pytest.mark.parametrize(("duration", "steps"), [(1e-6, 1), (0.05, 10), (0.0524, 10), (0.053, 11)])
def test_the_duration_is_rounded_to_whole_steps(duration, steps):
    assert len(schedule([1], duration=duration)) == steps


# Several sensors together, and functions of the state


def height(x, u, t):
    return x[..., 2:3]


def scalar(x, u, t):
    return x[..., 2]


def for_one_run(x, u, t):
    return np.stack([x[:, 0], x[:, 1]], axis=-1)


def test_sensors_taken_together_are_one_channel_in_place_of_themselves():
    R = np.diag([4.0, 9.0, 16.0, 1.0])
    R[0, 3] = R[3, 0] = 1.5
    channels, _ = build(imu={"of": ["gyro", "lift_encoder"], "cov": R.tolist(), "rate": 125})
    assert [c.name for c in channels] == ["wrist_quat", "attitude", "imu"]
    imu, model = channels[-1], zoo_model("joints")
    assert imu.kind == "gyro + jointpos"
    assert imu.sensors == ("gyro", "lift_encoder")
    assert imu.space.names == ("gyro.x", "gyro.y", "gyro.z", "lift_encoder")
    adr = [model.sensor(name).adr[0] for name in imu.sensors]
    assert imu.columns.tolist() == [adr[0], adr[0] + 1, adr[0] + 2, adr[1]]
    assert imu.timing.period == 2
    noise = at_zero(imu, 1, range(40), 500).reshape(-1, 4)
    sigma = np.sqrt((np.outer(np.diag(R), np.diag(R)) + R**2) / len(noise))
    assert (np.abs(noise.T @ noise / len(noise) - R) < 6 * sigma).all()


def test_a_member_is_a_channel_of_its_own_where_it_is_asked_for():
    both, _ = build(["imu", "gyro"], imu={"of": ["gyro", "lift_encoder"]})
    assert [c.name for c in both] == ["gyro", "imu"]
    alone, _ = build(["gyro"], imu={"of": ["gyro", "lift_encoder"]})
    assert [c.name for c in alone] == ["gyro"]
    off, _ = build(imu={"of": ["gyro", "lift_encoder"], "enabled": False})
    assert "gyro" in [c.name for c in off]


def test_what_is_taken_together_has_the_noise_and_cutoff_of_each():
    model = model_with(
        '<jointpos name="a" joint="hinge" noise="0.25" cutoff="3"/>'
        '<jointvel name="v" joint="slide"/>'
    )
    (both,), notices = build(model=model, both={"of": ["v", "a"]})
    np.testing.assert_allclose(np.sqrt(np.diag(both.cov)), [0.02, 0.25])
    assert notices == ["both: no noise given; assuming 0.02 m/s"]
    assert both.imperfections is not None
    np.testing.assert_array_equal(both.imperfections.cutoff, [np.inf, 3.0])


def test_some_axes_of_a_sensor():
    (rates,), _ = build(["gyro"], gyro={"axes": [2, 0], "noise": [0.1, 0.2]})
    assert rates.space.names == ("gyro.z", "gyro.x")
    start = zoo_model("joints").sensor("gyro").adr[0]
    assert rates.columns.tolist() == [start + 2, start]
    np.testing.assert_allclose(np.diag(rates.cov), [0.01, 0.04])
    model = model_with('<jointpos name="a" joint="hinge" noise="0.25" cutoff="3"/>'
                       '<jointvel name="v" joint="slide" noise="0.5"/>')  # fmt: skip
    (one,), _ = build(model=model, one={"of": ["v", "a"], "axes": [1]})
    assert one.space.names == ("a",)
    assert one.cov == 0.25**2
    assert one.imperfections is not None
    np.testing.assert_array_equal(one.imperfections.cutoff, [3.0])


def test_a_function_of_the_state_is_a_channel():
    target = f"{__name__}:height"
    channels, notices = build(baro={"function": target, "unit": "m", "rate": 25})
    baro = channels[-1]
    assert (baro.name, baro.kind, baro.sensors) == ("baro", "function", ())
    assert (baro.space.names, baro.space.units) == (("baro",), ("m",))
    assert baro.cov == 0.01**2
    assert any("assuming 0.01 m (lift_encoder, baro)" in line for line in notices)
    assert baro.columns.size == 0
    with pytest.raises(ScenarioError, match=r"channels\.baro is no single MuJoCo sensor"):
        _ = baro.index


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ({"of": ["gyr", "attitude"]}, r"extra\.of: no sensor 'gyr' \(did you mean 'gyro'\?\)"),
        ({"of": ["gyro", "gyro"]}, r"extra\.of is \['gyro', 'gyro'\]; name each .* once"),
        ({"of": []}, r"extra\.of is \[\]; name each"),
        ({"of": ["gyro"], "function": "a:b"}, "extra has of and function; give one of them"),
        ({"of": ["gyro"], "unit": "m"}, r"extra\.unit is for a function"),
        ({"of": ["gyro"], "angles": [0]}, r"extra\.angles is for a function"),
        ({"function": "height"}, r"extra\.function is 'height'; use 'module:function'"),
        ({"function": f"{__name__}:heigt"}, r"no function 'heigt' \(did you mean 'height'"),
        ({"function": f"{__name__}:scalar"}, r"returned shape .*; expected .*keep the last axis"),
        ({"function": f"{__name__}:for_one_run"}, r"expected \(3, 2, 2\): index the state as x\["),
        (
            {"function": f"{__name__}:height", "angles": [1]},
            r"extra\.angles is \[1\]; use some of 0",
        ),
        ({"of": ["gyro"], "axes": [3]}, r"extra\.axes is \[3\]; use some of 0 to 2, each once"),
        ({"of": ["gyro"], "axes": [1, 1]}, r"extra\.axes is \[1, 1\]; use some"),
        ({"of": ["gyro"], "axes": []}, r"extra\.axes is \[\]; use some"),
        ({"of": ["attitude"], "axes": [0]}, r"extra\.axes: a quaternion has no single axes"),
        ({"function": f"{__name__}:height", "axes": [0]}, r"extra\.axes is for sensors"),
    ],
)
def test_bad_channels_that_are_not_one_sensor(section, message):
    with pytest.raises(ScenarioError, match=message):
        build(extra=section)


def test_a_new_channel_needs_a_name_of_its_own():
    with pytest.raises(ScenarioError, match=r"channels\.gyro: a sensor has this name"):
        build(gyro={"of": ["lift_encoder"]})


def test_sensors_of_different_rhythm_need_one():
    given_by_mjcf = {"gyro": MjcfTiming(0.1, 0.0, 0.0, 1)}
    section = {"imu": ChannelSection(of=["gyro", "lift_encoder"])}
    with pytest.raises(ScenarioError, match=r"imu\.of: .*different interval, .*imu\.rate and"):
        sensors.build(zoo_model("joints"), section, None, 1, mjcf_timings=given_by_mjcf)
    given = {"imu": ChannelSection(of=["gyro", "lift_encoder"], rate=50, latency=0)}
    channels, _ = sensors.build(zoo_model("joints"), given, None, 1, mjcf_timings=given_by_mjcf)
    assert channels[-1].timing.period == 5


def test_a_sensor_free_of_noise_needs_an_r_that_is_believed():
    belief = {"gyro": BelievedChannelSection(noise=0.1)}
    section = {"gyro": ChannelSection(noise=[0.0, 0.1, 0.0])}
    (gyro,), _ = sensors.build(zoo_model("joints"), section, ["gyro"], 1, believed=belief)
    noise = at_zero(gyro, 0, range(3), 4)
    np.testing.assert_array_equal(noise[..., [0, 2]], 0.0)
    assert (noise[..., 1] != 0).all()
    np.testing.assert_allclose(sensors.believed_covariance(gyro, belief["gyro"]), 0.01 * np.eye(3))
