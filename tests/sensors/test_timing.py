import mujoco
import numpy as np
import pytest

from estbench.errors import ScenarioError
from estbench.experiment import setup
from estbench.robots.library import engine
from estbench.scenario.load import load
from estbench.sensors.sampling import Sampler
from estbench.sensors.timing import Instant, MjcfTiming, Schedule, Timing, instants
from tests.helpers import arrived, sampled

# When


def test_readings_are_due_at_the_phase_and_every_period():
    assert Timing(3).due(10).tolist() == [3, 6, 9]
    assert Timing(3, phase=1).due(10).tolist() == [1, 4, 7, 10]
    assert Timing(3, phase=7).due(10).tolist() == [7, 10]
    assert Timing(20).due(10).tolist() == []


def test_an_uneven_rhythm_takes_the_first_step_that_is_not_earlier():
    assert Timing(2, fractional=(2.5, 2.5)).due(11).tolist() == [3, 5, 8, 10]
    assert Timing(2, fractional=(1.0, 10 / 3)).due(12).tolist() == [1, 5, 8, 11]
    assert Timing(2, fractional=(2.5, 2.5)).due(2).tolist() == []


def test_the_first_reading_in_seconds():
    assert Timing(3, timestep=0.01).first == 0.03
    assert Timing(3, phase=1, timestep=0.01).first == 0.01
    assert Timing(2, fractional=(1.5, 2.5), timestep=0.01).first == 0.015


def test_jitter_is_uniform_within_its_bound():
    timing = Timing(20, jitter=3)
    off = sampled(timing, 5, range(50), "a", 20 * 200) - timing.due(20 * 200)[:, None]
    assert off.shape == (200, 50)
    counts = np.unique(off, return_counts=True)
    assert counts[0].tolist() == [-3, -2, -1, 0, 1, 2, 3]
    # A count is binomial(10000, 1/7); 5.5 standard deviations, seven times: below 1e-6.
    p, n = 1 / 7, off.size
    assert (np.abs(counts[1] - n * p) < 5.5 * np.sqrt(n * p * (1 - p))).all()


def test_latency_is_rounded_up_to_the_next_step_and_never_negative():
    taken = sampled(Timing(4), 0, range(3), "a", 40)
    for latency, steps in ((0.0, 0), (0.2, 1), (1.0, 1), (2.5, 3), (16.0, 16)):
        arrives = arrived(Timing(4, latency=latency), taken, 0, range(3), "a")
        np.testing.assert_array_equal(arrives, taken + steps)
    timing = Timing(4, latency=1.0, latency_std=2.0)
    assert (arrived(timing, taken, 0, range(3), "a") >= taken).all()


def test_random_latency_has_its_mean_and_standard_deviation():
    timing = Timing(1, latency=100.0, latency_std=5.0)
    taken = sampled(timing, 1, range(40), "a", 500)
    late = arrived(timing, taken, 1, range(40), "a") - taken
    n = late.size
    # Rounding up adds half a step and a variance of 1/12. Six standard deviations: 2e-9.
    assert abs(late.mean() - 100.5) < 6 * 5 / np.sqrt(n)
    assert abs(late.var() - 25 - 1 / 12) < 6 * 25 * np.sqrt(2 / n)
    assert timing.longest_delay == 125
    assert (late <= timing.longest_delay + 1).all()


def test_each_run_has_its_own_jitter_and_latency_whatever_its_company():
    timing = Timing(10, jitter=4, latency=3.0, latency_std=2.0)
    together = sampled(timing, 1, range(6), "a", 100)
    late = arrived(timing, together, 1, range(6), "a")
    for run in range(6):
        alone = sampled(timing, 1, [run], "a", 100)
        np.testing.assert_array_equal(alone[:, 0], together[:, run])
        np.testing.assert_array_equal(arrived(timing, alone, 1, [run], "a")[:, 0], late[:, run])
    assert (late[:, 0] != late[:, 1]).any()


def test_punctual():
    assert Timing(3, phase=2).punctual
    for late in (
        Timing(3, jitter=1), Timing(3, latency=1.0), Timing(3, latency_std=1.0),
        Timing(3, fractional=(1.5, 1.5)),
    ):  # fmt: skip
        assert not late.punctual


def test_jittered_instants_are_instants_and_jitter_is_less_than_half_a_period():
    found = instants([("a", Timing(5, jitter=2, timestep=0.01))], 0.01, 10, 0.2)
    assert [i.tick for i in found] == [3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18,
                                       19, 20]  # fmt: skip
    assert [i.tick for i in found if i.channels] == [5, 10, 15, 20]
    with pytest.raises(ScenarioError, match=r"channels\.a\.jitter is 0\.03 s; .*half the period"):
        instants([("a", Timing(6, jitter=3, timestep=0.01))], 0.01, 1, 0.2)


RHYTHMS = {
    "plain": [Timing(4)],
    "between": [Timing(3), Timing(10, phase=7)],
    "later than the end": [Timing(500)],
    "jitter": [Timing(5, jitter=2), Timing(9, phase=1, jitter=3)],
    "fractional": [Timing(2, fractional=(2.5, 2.5)), Timing(3, fractional=(0.75, 10 / 3))],
    "all": [Timing(7, jitter=3, latency=4.0), Timing(2, fractional=(1.0, 2.25)), Timing(6)],
}


def counted(named, frame_skip, last):
    """The instants of a run, found tick by tick."""
    times = {name: timing.due(last).tolist() for name, timing in named}
    around = {
        due + off
        for name, timing in named
        for due in times[name]
        for off in range(-timing.jitter, timing.jitter + 1)
    }
    out, before = [], 0
    for tick in range(1, last + 1):
        if tick % frame_skip and tick not in around:
            continue
        names = tuple(name for name, _ in named if tick in times[name])
        control = before % frame_skip == 0
        out.append(Instant(before * 0.01, tick * 0.01, tick - before, names, control, tick))
        before = tick
    return out


@pytest.mark.parametrize("rhythm", RHYTHMS)
@pytest.mark.parametrize("frame_skip", [1, 3, 4])
def test_the_control_periods_of_a_schedule_are_the_instants(rhythm, frame_skip):
    named = [(f"c{i}", timing) for i, timing in enumerate(RHYTHMS[rhythm])]
    count = 30
    last = count * frame_skip
    expected = counted(named, frame_skip, last)
    assert instants(named, 0.01, frame_skip, last * 0.01) == expected
    ended = Schedule(named, 0.01, frame_skip, last)
    assert [i for k in range(count) for i in ended.period(k)] == expected
    # Nothing is due after the end: a step is divided by the jitter of its last readings at most.
    assert not any(i.channels for i in ended.period(count))
    assert [len(ended.period(count + k)) for k in (8, 9)] == [1, 1]
    # Without an end: as in a longer run, in which the last periods are no different.
    endless = Schedule(named, 0.01, frame_skip)
    longer = counted(named, frame_skip, 2 * last)
    found = [i for k in range(count) for i in endless.period(k)]
    assert found == [i for i in longer if i.tick <= last]
    # Where it says that no reading falls between the steps, none does.
    assert not endless.plain or all(i.nstep == frame_skip for i in longer)
    assert endless.plain or frame_skip == 1 or len(found) > count or rhythm == "later than the end"


def test_a_schedule_forgets_and_makes_anew(monkeypatch):
    monkeypatch.setattr("estbench.sensors.timing._REMEMBERED", 3)
    named = [("a", Timing(3, jitter=1)), ("b", Timing(2, fractional=(2.5, 2.5)))]
    schedule, other = (Schedule(named, 0.01, 4) for _ in range(2))
    first = [schedule.period(k) for k in range(10)]
    assert [other.period(k) for k in reversed(range(10))] == first[::-1]
    assert [schedule.period(k) for k in range(10)] == first
    assert len(schedule._known) <= 3


def test_a_run_with_more_instants_than_fit_into_memory_is_refused(monkeypatch):
    # Steps of 2 ticks; readings every 4 add no instant; every 5 they may.
    named = [("a", Timing(4)), ("b", Timing(5))]
    assert len(instants(named, 0.01, 2, 0.2)) == 10 + 2
    monkeypatch.setattr("estbench.sensors.timing.MOST_INSTANTS", 15)
    assert instants(named, 0.01, 2, 0.2)
    message = r"is 1e\+09 s: 5e\+10 steps of 0\.02 s.* 7e\+10 instants.*at most 15; .*seconds"
    with pytest.raises(ScenarioError, match=message):
        instants(named, 0.01, 2, 1e9)
    every = [("a", Timing(1)), ("b", Timing(3, jitter=1))]  # never more than one per tick
    assert len(instants(every, 0.01, 2, 0.14)) == 14
    with pytest.raises(ScenarioError, match="16 instants"):
        instants(every, 0.01, 2, 0.16)
    with pytest.raises(ScenarioError, match="22 instants"):  # 2 steps, and 5 ticks around each
        instants([("a", Timing(10, jitter=2))], 0.01, 20, 0.4)


# MuJoCo's own interval and delay

T = 1 / 128  # exact in binary: MuJoCo's clock then does not drift
NATIVE = [
    {"nsample": 1},
    {"nsample": 1, "interval": (3, 0)},
    {"nsample": 2, "interval": (3, -1)},
    {"nsample": 1, "interval": (3, -2)},
    {"nsample": 1, "interval": (3, -1.5)},
    {"nsample": 4, "interval": (2.5, 0)},
    {"nsample": 4, "interval": (2.5, -0.75)},
    {"nsample": 1, "interval": (0.5, 0)},
    {"nsample": 4, "delay": 3},
    {"nsample": 3, "delay": 3},
    {"nsample": 4, "delay": 2.5},
    {"nsample": 2, "delay": 5},  # the history is too short: MuJoCo reads its oldest
    {"nsample": 4, "interval": (4, 0), "delay": 2},
    {"nsample": 4, "interval": (4, 0), "delay": 2.5},
    {"nsample": 4, "interval": (4, -1), "delay": 5},
    {"nsample": 9, "interval": (2.5, -1), "delay": 3},
    {"nsample": 1, "interval": (4, 0), "delay": 2},
    {"nsample": 2, "interval": (4, 0), "delay": 10},
    {"nsample": 3, "interval": (4, 0), "delay": 10},
    {"nsample": 2, "interval": (2.5, 0), "delay": 9},
    {"interval": (4, 0)},  # without a history MuJoCo ignores it
]


def mjcf(native):
    attributes = ""
    if "nsample" in native:
        attributes += f' nsample="{native["nsample"]}"'
    if "interval" in native:
        attributes += ' interval="{} {}"'.format(*(T * n for n in native["interval"]))
    if "delay" in native:
        attributes += f' delay="{T * native["delay"]}"'
    return f"""
    <mujoco><option timestep="{T}" gravity="0 0 0"/>
    <worldbody><body><joint name="x" type="slide"/><geom size="0.1" mass="1"/></body></worldbody>
    <sensor><jointpos name="x" joint="x" noise="1e-9" {attributes}/></sensor></mujoco>"""


def shown_by_mujoco(text, steps):
    """The tick whose sample `sensordata` shows at each tick 1, 2, ...; 0 for nothing yet."""
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.qvel[0] = 1.0  # the position is the time
    shown = []
    for _ in range(steps + 1):
        mujoco.mj_step(model, data)  # sensordata is that of the state before the step
        shown.append(round(float(data.sensordata[0]) / T))
    return shown[1:]


@pytest.mark.parametrize("native", NATIVE, ids=str)
def test_the_mjcf_timing_is_mujocos(native, tmp_path):
    (tmp_path / "m.xml").write_text(mjcf(native))
    steps = 40
    overrides = ["initial.std=1e-6", f"simulation.duration={steps * T}"]
    prepared = setup.build(load(tmp_path / "m.xml", overrides))
    (channel,) = prepared.channels
    sampler = Sampler([channel], 2, steps)
    sampler.start(np.arange(2), 0, range(2), 0)
    newest, shown = 0, []
    assert [i.tick for i in prepared.instants] == list(range(1, steps + 1))
    for tick in range(1, steps + 1):
        clean = np.full((2, 1), float(tick)) if sampler.takes(tick) else None
        for delivery in sampler.at(tick, clean):
            assert delivery.mask is None
            np.testing.assert_allclose(delivery.y, delivery.taken, atol=1e-6)
            newest = max(newest, delivery.taken)
        shown.append(newest)
    assert shown == shown_by_mujoco(mjcf(native), steps)


def test_the_mjcf_delay_is_what_the_filter_is_told_late(tmp_path):
    text = mjcf({"nsample": 4, "interval": (4, -1), "delay": 5})
    (tmp_path / "m.xml").write_text(text)
    with engine():
        prepared = setup.build(load(tmp_path / "m.xml"))
    assert prepared.channels[0].timing == Timing(4, 3, latency=5.0, timestep=T, history=4)
    assert prepared.window >= 5


def test_the_scenario_overrides_the_mjcf(tmp_path):
    (tmp_path / "m.xml").write_text(mjcf({"nsample": 4, "interval": (4, -1), "delay": 5}))

    def timing(*overrides):
        return setup.build(load(tmp_path / "m.xml", overrides)).channels[0].timing

    assert timing("channels.x.rate=64") == Timing(2, latency=5.0, timestep=T)
    assert timing("channels.x.latency=0.0") == Timing(4, 3, timestep=T)
    assert timing("channels.x.phase=0.015625").phase == 2
    assert timing("channels.x.phase=0").phase == 0  # one period, as ever


def test_mjcf_timing_rounds_to_steps():
    assert MjcfTiming(0.1, 0.0, 0.0, 1).timing(0.01, 3) == Timing(10, 10, timestep=0.01)
    assert MjcfTiming(0.0, 0.0, 0.05, 9).timing(0.01, 3).latency == pytest.approx(5)
    assert MjcfTiming(0.1, 0.0, 0.05, 0).timing(0.01, 3) == Timing(3, timestep=0.01)


def test_the_rate_is_the_mean_rate_whatever_the_timestep(tmp_path):
    even = Timing(5, timestep=0.002)
    assert (even.interval, even.rate) == (pytest.approx(0.01), pytest.approx(100.0))
    # interval="0.0033" with a timestep of 0.002 s: readings every 1.65 steps on average.
    timing = MjcfTiming(0.0033, 0.0, 0.0, 4).timing(0.002, 5)
    assert timing.interval == pytest.approx(0.0033)
    assert timing.rate == pytest.approx(1 / 0.0033)
    seconds = len(timing.due(50_000)) / timing.rate
    assert seconds == pytest.approx(50_000 * 0.002, rel=1e-4)


def test_a_noise_density_is_that_of_the_mean_rate(tmp_path):
    text = mjcf({"nsample": 4}).replace(f'timestep="{T}"', 'timestep="0.002"')
    (tmp_path / "m.xml").write_text(text.replace("nsample=", 'interval="0.0033" nsample='))
    prepared = setup.build(load(tmp_path / "m.xml", ["channels.x.noise_density=0.001"]))
    (channel,) = prepared.channels
    assert np.sqrt(channel.cov) == pytest.approx(0.001 / np.sqrt(0.0033))
