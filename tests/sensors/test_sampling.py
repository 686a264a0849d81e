"""Who samples when, what arrives when: counted, and compared with MuJoCo's own sensordata."""

from collections.abc import Sequence

import mujoco
import numpy as np
import pytest

from estbench.experiment import setup
from estbench.robots.no_return import may_miss
from estbench.scenario.channels import ChannelSection
from estbench.scenario.load import load
from estbench.sensors import channel as sensors
from estbench.sensors.delivery import divided
from estbench.sensors.sampling import Sampler
from estbench.sensors.timing import instants
from tests.helpers import SENSORS, arrived, sampled, simulated, zoo_model

EVERYTHING = {
    "bias": 0.1, "bias_walk": 0.05, "drift": 0.1, "drift_time": 0.5, "scale_factor": 0.01,
    "quantization": 0.01, "cutoff": 50.0, "deadband": 0.02, "outlier_probability": 0.1,
    "student_dof": 5.0, "dropout": 0.2, "dropout_length": 2.0, "stuck": 0.05, "stuck_length": 3.0,
    "rate": 62.5, "jitter": 0.004, "latency": 0.01, "latency_std": 0.02,
}  # fmt: skip
NOTHING = {
    "bias": 0.0, "bias_walk": 0.0, "drift": 0.0, "scale_factor": 0.0, "misalignment": 0.0,
    "quantization": 0.0, "deadband": 0.0, "outlier_probability": 0.0, "dropout": 0.0, "stuck": 0.0,
    "jitter": 0.0, "latency": 0.0, "latency_std": 0.0,
}  # fmt: skip


def started(section, runs: Sequence[int] = range(4), steps=60, name="lift_encoder", frame_skip=1):
    """A sampler on some runs, and the instants of these runs."""
    model = zoo_model("joints")  # 4 ms steps
    (channel,), _ = sensors.build(model, {name: ChannelSection(**section)}, [name], frame_skip)
    found = instants([(name, channel.timing)], model.opt.timestep, frame_skip, 0.004 * steps)
    sampler = Sampler([channel], len(runs), found[-1].tick)
    sampler.start(np.arange(len(runs)), 3, runs, 0)
    return sampler, found


def unpacked(delivery, rows):
    """A delivery row by row: `(row, due, y)` of those that it comes to."""
    due = np.broadcast_to(delivery.due, rows)
    came = range(rows) if delivery.mask is None else np.flatnonzero(delivery.mask)
    return [(r, int(due[r]), delivery.y[r].tolist()) for r in came]


def collect(sampler, found, runs):
    """[(arrival, taken, due, run, value)], of a true reading that tells tick and run apart."""
    out = []
    for tick in (instant.tick for instant in found):
        true = np.array([[1000.0 * tick + run] for run in runs])
        for d in sampler.at(tick, true if sampler.takes(tick) else None):
            out += [(tick, d.taken, due, runs[r], y) for r, due, (y,) in unpacked(d, len(runs))]
    return out


# When


TIMINGS = [
    {},
    {"rate": 125},
    {"rate": 25, "phase": 0.012},
    {"rate": 25, "latency": 0.03},
    {"rate": 25, "jitter": 0.016},
    {"rate": 62.5, "jitter": 0.004, "latency": 0.01, "latency_std": 0.02},
    {"rate": 250, "latency": 0.02, "latency_std": 0.03},
    {"rate": 50, "dropout": 0.4, "dropout_length": 3.0, "jitter": 0.008, "latency_std": 0.02},
]


def test_the_noise_of_a_scheduled_reading_is_that_of_the_time_at_which_it_is_taken():
    """Not that of the time at which it was due; both kinds are near the change of the noise."""
    section = {"noise": 1e-3, "rate": 25, "jitter": 0.016, "schedule": [(0.12, 1.0), (9.0, 1e6)]}
    sampler, found = started(section, range(40), 60)
    sides = []
    for tick in (instant.tick for instant in found):
        true = np.zeros((40, 1)) if sampler.takes(tick) else None
        for d in sampler.at(tick, true):
            for _, due, (y,) in unpacked(d, 40):
                assert (abs(y) > 0.1) == (d.taken * 0.004 > 0.12 + 1e-9)
                sides.append((d.taken > 30, due > 30))
    assert {(True, False), (False, False), (True, True)} <= set(sides)


@pytest.mark.parametrize("section", TIMINGS, ids=str)
@pytest.mark.parametrize("frame_skip", [1, 3])
def test_every_reading_arrives_once_with_what_was_true_when_it_was_taken(section, frame_skip):
    runs = list(range(40))
    sampler, found = started({"noise": 1e-6, **section}, runs, frame_skip=frame_skip)
    channel, ticks = sampler.channel, np.array([i.tick for i in found])
    last = ticks[-1]
    due = channel.timing.due(last)
    taken = sampled(channel.timing, 3, runs, channel.name, last)
    arrives = arrived(channel.timing, taken, 3, runs, channel.name)
    collected = collect(sampler, found, runs)
    seen = {(run, due): (arrival, at, value) for arrival, at, due, run, value in collected}
    assert len(seen) == len(collected)  # none twice
    lost = 0
    for j in range(len(due)):
        for r, run in enumerate(runs):
            if arrives[j, r] > last:
                assert (run, due[j]) not in seen
                continue
            found_ = seen.pop((run, due[j]), None)
            if found_ is None:
                lost += 1
                continue
            arrival, at, value = found_
            assert at == taken[j, r]
            assert value == pytest.approx(1000 * taken[j, r] + run, abs=1e-4)
            # The first instant that is not earlier.
            assert arrival == ticks[np.searchsorted(ticks, arrives[j, r])]
    assert not seen  # none from nowhere
    assert (lost > 0) == ("dropout" in section)


def test_an_arrival_waits_for_the_next_instant():
    sampler, found = started(
        {"noise": 1e-6, "rate": 62.5, "latency": 0.005}, frame_skip=4, steps=16
    )
    assert [i.tick for i in found] == [4, 8, 12, 16]
    assert [(arrival, taken) for arrival, taken, *_ in collect(sampler, found, [0])] == [
        (8, 4),
        (12, 8),
        (16, 12),
    ]


def test_readings_with_random_latency_overtake_each_other():
    sampler, found = started({"noise": 1e-6, "latency": 0.02, "latency_std": 0.02}, steps=200)
    order = [taken for _, taken, _, run, _ in collect(sampler, found, range(4)) if run == 0]
    assert order != sorted(order)
    assert sorted(order) == sorted(set(order))


# What


def test_with_jitter_each_run_sees_the_truth_of_its_own_time():
    """A stuck-at fault remembers it too: the memory is a run's own."""
    section = {"noise": 1e-9, "rate": 25, "jitter": 0.016, "stuck": 0.5, "stuck_length": 2.0}
    runs = list(range(30))
    sampler, found = started(section, runs, steps=400)
    values = {}
    for _, taken, _, run, value in collect(sampler, found, runs):
        fresh = 1000 * taken + run
        previous = values.get(run)
        assert value == pytest.approx(fresh, abs=1e-4) or value == previous
        values[run] = value


@pytest.mark.parametrize("section", [{}, EVERYTHING], ids=["white", "everything"])
@pytest.mark.parametrize("name", ["lift_encoder", "gyro", "attitude"])
def test_a_run_reads_the_same_alone_and_among_others(name, section):
    flat = ("scale_factor", "quantization", "cutoff", "deadband")
    section = {k: v for k, v in section.items() if name != "attitude" or k not in flat}

    def deliveries(runs):
        sampler, found = started(section, runs, name=name)
        space, out = sampler.channel.space, {}
        for instant in found:
            clean = None
            if sampler.takes(instant.tick):
                x = np.array([[0.1 * run, instant.end, 1.0] for run in runs])[:, : space.n]
                start = np.zeros(space.nx)
                start[space.quaternions[:, 0]] = 1.0
                clean = space.plus(np.broadcast_to(start, (len(runs), space.nx)), x)
            for d in sampler.at(instant.tick, clean):
                for r, due, y in unpacked(d, len(runs)):
                    out[runs[r], due] = (instant.tick, d.taken, y)
        return out

    together = deliveries(range(12))
    apart = {}
    for runs in ([0, 1, 2], [3], list(range(4, 12))):
        apart |= deliveries(runs)
    assert apart == together


# MuJoCo's sensordata


def exact(path, *more):
    """A scenario of an MJCF whose sensors have every imperfection, all of them zero."""
    names = [s.name for s in mujoco.MjSpec.from_file(str(path)).sensors]
    overrides = [f"filter.channels.{n}.noise=0.1" for n in names]
    overrides += [f"channels.{n}.noise=0" for n in names]
    overrides += [f"channels.{n}.{k}={v}" for n in names for k, v in NOTHING.items()]
    return setup.build(
        load(path, [*overrides, "control.kind=sine", "control.amplitude=0.4", *more])
    )


# What `SENSORS` leaves out: contact, tendons at their limits, geometry, energy, a camera.
OTHERS = """
<mujoco><option timestep="0.005"><flag energy="enable"/></option>
<worldbody>
  <camera name="camera" pos="0 -3 1" xyaxes="1 0 0 0 0 1" resolution="640 480" fovy="60"/>
  <geom name="floor" type="plane" size="2 2 1"/>
  <body pos="0 0 0.6"><joint name="arm" axis="0 1 0"/><site name="tip" pos="0.5 0 0"/>
    <geom name="arm" type="capsule" size="0.05" fromto="0 0 0 0.5 0 0" mass="1"/></body>
  <body name="ball" pos="1 0 0.1"><freejoint/><geom name="ball" size="0.1" mass="0.3"/>
    <site name="skin" size="0.2"/></body>
  <body pos="-1 0 0.5"><joint name="slide" type="slide" axis="0 0 1"/>
    <geom size="0.1" mass="0.4" contype="0" conaffinity="0"/></body>
</worldbody>
<tendon><fixed name="tendon" limited="true" range="-0.2 0.2"><joint joint="arm" coef="1"/>
  <joint joint="slide" coef="0.5"/></fixed></tendon>
<actuator><motor name="pull" tendon="tendon"/></actuator>
<sensor>
  <touch name="touch" site="skin"/><camprojection name="pixel" site="tip" camera="camera"/>
  <contact name="contact" geom1="ball" geom2="floor" num="1" data="found force dist"/>
  <e_kinetic name="energy"/><frameyaxis name="yaxis" objtype="site" objname="tip"/>
  <distance name="distance" geom1="ball" geom2="arm" cutoff="2"/>
  <normal name="normal" geom1="ball" geom2="arm" cutoff="2"/>
  <fromto name="fromto" geom1="ball" geom2="arm" cutoff="2"/>
  <insidesite name="inside" site="skin" objtype="body" objname="ball"/>
  <tendonactuatorfrc name="tendon_force" tendon="tendon"/>
  <tendonlimitpos name="limit" tendon="tendon"/><tendonlimitvel name="limit_rate" tendon="tendon"/>
  <tendonlimitfrc name="limit_force" tendon="tendon"/>
</sensor></mujoco>"""


def assert_sensordata(path, duration, *settings):
    """Readings free of imperfections are those of `mj_forward`, if there is a return.

    Returns:
        Names of the sensors that were not always zero, and of those seen at their cutoff.
    """
    prepared = exact(path, f"simulation.duration={duration}", *settings)
    runs = range(4)
    trajectory = simulated(prepared, len(runs))
    original = mujoco.MjModel.from_xml_path(str(path))
    # The solver then begins where it begins in estbench: forces of constraints agree to the bit.
    original.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_WARMSTART
    alive, clipped = set(), set()
    for k, instant in enumerate(prepared.instants):
        arrived = {d.channels[0]: d for d in divided(trajectory.deliveries[k])}
        assert list(arrived) == [c.name for c in prepared.channels]
        for run in runs:
            data = mujoco.MjData(original)
            nq, nv = original.nq, original.nv
            data.qpos, data.qvel = np.split(trajectory.x[k + 1, run][: nq + nv], [nq])
            data.ctrl, data.time = trajectory.u[k, run], instant.end
            mujoco.mj_forward(original, data)
            for c in prepared.channels:
                expected, delivery = data.sensor(c.name).data, arrived[c.name]
                limit = original.sensor(c.name).cutoff[0]
                if delivery.mask is not None and not delivery.mask[run]:
                    assert may_miss(original, original.sensor(c.name).id)
                    assert np.isin(expected, [0.0, -1.0, limit]).all()
                    continue
                np.testing.assert_array_equal(delivery.y[run], expected, c.name)
                alive |= {c.name} if expected.any() else set()
                clipped |= {c.name} if limit and np.abs(expected).max() == limit else set()
    return alive, clipped


@pytest.mark.parametrize("skip", [1, 3])
def test_without_imperfections_readings_are_mujocos_sensordata(tmp_path, skip):
    text = SENSORS.replace('name="gyro"', 'name="gyro" cutoff="0.2"')
    text = text.replace('name="tendonpos"', 'name="tendonpos" cutoff="0.01"')
    (tmp_path / "m.xml").write_text(text)
    settings = (f"model.frame_skip={skip}", "initial.std=0.4")
    _, clipped = assert_sensordata(tmp_path / "m.xml", 0.15, *settings)
    assert {"gyro", "tendonpos"} <= clipped


def test_contacts_limits_geometry_and_energy_are_mujocos_too(tmp_path):
    (tmp_path / "m.xml").write_text(OTHERS)
    alive, _ = assert_sensordata(tmp_path / "m.xml", 0.3, "initial.std=0.3")
    assert alive == {s.name for s in mujoco.MjSpec.from_string(OTHERS).sensors}


def test_zero_imperfections_are_no_imperfections(tmp_path):
    (tmp_path / "m.xml").write_text(SENSORS)
    prepared = exact(tmp_path / "m.xml")
    assert all(c.imperfections is None and c.timing.punctual for c in prepared.channels
               if not zoo_model("sensors").sensor(c.name).cutoff[0])  # fmt: skip


# Rows on clocks of their own

STREAKS = {"dropout": 0.3, "dropout_length": 2.5, "stuck": 0.2, "stuck_length": 3.0}
ROWS_APART = {
    "punctual": {"rate": 125},
    "phase": {"rate": 25, "phase": 0.012},
    "latency": {"rate": 62.5, "latency": 0.03},
    "jitter": {"rate": 25, "jitter": 0.016},
    "random latency": {"latency": 0.02, "latency_std": 0.03},
    "jitter, random latency": {"rate": 50, "jitter": 0.008, "latency": 0.01, "latency_std": 0.02},
    "gaps and faults": {"rate": 125, **STREAKS},
    "all": {"rate": 50, "jitter": 0.008, "latency_std": 0.02, "bias": 0.1, "bias_walk": 0.2,
            "drift": 0.1, "drift_time": 0.1, "scale_factor": 0.01, "outlier_probability": 0.2,
            **STREAKS},
    "schedule": {"rate": 125, "schedule": [(0.06, 2.0), (0.1, 5.0), (9.0, 1.0)]},
    "schedule, jitter": {"rate": 25, "jitter": 0.016, "schedule": [(0.12, 2.0), (9.0, 5.0)]},
}  # fmt: skip
# tick -> the rows that begin there, and their runs; some while readings are on their way.
BEGINNINGS = {
    0: ([0, 1, 2, 3], [0, 1, 2, 3]), 7: ([2], [4]), 10: ([0, 3], [5, 6]), 11: ([1], [7]),
    30: ([3, 2], [0, 8]), 33: ([2], [9]), 90: ([0, 1, 2, 3], [1, 4, 9, 3]),
}  # fmt: skip
LAST = 140


def true_reading(elapsed, runs):
    return np.array([[1000.0 * e + run] for e, run in zip(elapsed, runs)])


def sampler_of(section, rows, last=None):
    model = zoo_model("joints")
    sections = {"lift_encoder": ChannelSection(**{"noise": 0.5, **section})}
    (channel,), _ = sensors.build(model, sections, ["lift_encoder"], 1, 9.0)
    return Sampler([channel], rows, last)


def heard(deliveries, tick, began, runs):
    """(run, what it hears by its own clock: arrival, taken, due, reading), in order."""
    for d in deliveries:
        for r, due, y in unpacked(d, len(runs)):
            yield r, (tick - began[r], d.taken - began[r], due - began[r], y)


def alone(section, run, ticks, last=None):
    """What a run hears in its first ticks."""
    sampler, out = sampler_of(section, 1, last), []
    sampler.start(np.arange(1), 3, [run], 0)
    for tick in range(1, ticks + 1):
        clean = true_reading([tick], [run]) if sampler.takes(tick) else None
        out += [told for _, told in heard(sampler.at(tick, clean), tick, [0], [run])]
    return out


@pytest.mark.parametrize("split", [False, True], ids=["all", "some, then the others"])
@pytest.mark.parametrize("name", ROWS_APART)
def test_rows_that_begin_at_different_ticks_hear_what_they_hear_alone(name, split):
    """With `split` the rows go on in two groups at each tick, as those of two clocks do."""
    section, rows = ROWS_APART[name], 4
    rng = np.random.default_rng(0)
    sampler = sampler_of(section, rows)
    began, runs = np.zeros(rows, int), np.zeros(rows, int)
    told = [[] for _ in range(rows)]
    compared, lost_on_the_way = 0, 0

    def compare(row, now):
        nonlocal compared, lost_on_the_way
        expected = alone(section, runs[row], now - began[row])
        assert told[row] == expected
        compared += len(expected)
        later = alone(section, runs[row], now - began[row] + 40)
        lost_on_the_way += sum(taken <= now - began[row] < at for at, taken, *_ in later)
        told[row] = []

    for tick in range(LAST + 1):
        if tick:
            groups = [None]
            if split:
                mask = rng.random(rows) < 0.5
                groups = [g for g in (mask, ~mask) if g.any()]
            for moved in groups:
                true = true_reading(tick - began, runs)
                arrived = sampler.at(tick, true if sampler.takes(tick) else None, moved)
                for row, heard_ in heard(arrived, tick, began, runs):
                    assert moved is None or moved[row]
                    told[row].append(heard_)
        if tick in BEGINNINGS:
            here, new = BEGINNINGS[tick]
            if tick:
                for row in here:
                    compare(row, tick)
            sampler.start(np.array(here), 3, new, tick)
            began[here], runs[here] = tick, new
    for row in range(rows):
        compare(row, LAST)
    assert compared > 40
    assert (lost_on_the_way > 0) == any(k.startswith("latency") for k in section)


@pytest.mark.parametrize("name", ROWS_APART)
def test_a_run_hears_the_same_whether_its_end_is_known_or_not(name):
    section = ROWS_APART[name]
    known = alone(section, 5, 60, last=60)
    assert known
    assert known == [told for told in alone(section, 5, 60) if told[2] <= 60]


def test_a_row_that_has_not_moved_hears_it_later():
    sampler = sampler_of({"rate": 125, "latency": 0.008}, 2)  # every 2 ticks, 2 ticks late
    sampler.start(np.arange(2), 3, [0, 1], 0)
    first, both = np.array([True, False]), np.ones(2, bool)
    arrivals = []
    for tick in range(1, 7):
        moved = first if tick in (4, 5) else both
        clean = np.zeros((2, 1)) if sampler.takes(tick) else None
        arrivals += [
            (tick, r, d.taken) for d in sampler.at(tick, clean, moved) for r, *_ in unpacked(d, 2)
        ]
    assert [a for a in arrivals if a[1] == 0] == [(4, 0, 2), (6, 0, 4)]
    assert [a for a in arrivals if a[1] == 1] == [(6, 1, 2)]


@pytest.mark.parametrize("apart", [False, True], ids=["one clock", "clocks of their own"])
def test_an_interval_over_several_readings_takes_one_and_keeps_the_rhythm(apart):
    sampler = sampler_of({"rate": 125}, 2)  # every 2 ticks
    sampler.start(np.arange(2), 3, [0, 1], 0)
    if apart:
        sampler.start(np.array([1]), 3, [2], 0)
    taken = []
    for tick in (2, 7, 8, 9, 16, 17, 18):
        if sampler.takes(tick):
            (d,) = sampler.at(tick, np.zeros((2, 1)))
            assert d.mask is None
            taken.append((d.taken, np.broadcast_to(d.due, 2).tolist()))
    assert taken == [(2, [2, 2]), (7, [4, 4]), (8, [8, 8]), (16, [10, 10]), (18, [18, 18])]
