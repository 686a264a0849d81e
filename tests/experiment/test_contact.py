import base64
import json
import re

import numpy as np
import pytest

from estbench.analysis.compare import compare_stores
from estbench.analysis.formats import render
from estbench.consistency.intervals import positive_mean_interval
from estbench.consistency.phases import EVENTS
from estbench.errors import ScenarioError
from estbench.experiment import contact, setup
from estbench.experiment.recording import trajectory
from estbench.montecarlo import run as experiment
from estbench.report.contact import events
from estbench.report.figures import around, plots
from estbench.report.html import write_report
from estbench.report.sources import load
from estbench.scenario.schema import Scenario

HOPS = """<mujoco><option timestep="0.002"/><worldbody>
<geom type="plane" size="5 5 .1"/>
<body name="foot" pos="0 0 1"><joint name="z" type="slide" axis="0 0 1"/>
<geom size=".1" mass="1"/></body></worldbody>
<sensor><jointpos name="height" joint="z" noise="0.01"/></sensor></mujoco>"""
SPIN = """<mujoco><worldbody><body><joint name="spin" type="hinge"/><geom size=".1"/></body>
</worldbody><sensor><jointpos joint="spin" noise="0.01" name="angle"/></sensor></mujoco>"""


@pytest.fixture
def ball(tmp_path):
    """A ball that falls onto the floor from 0.4 m above it, as a table of settings."""
    path = tmp_path / "ball.xml"
    path.write_text(HOPS, encoding="utf-8")
    return {
        "name": "ball", "model": {"path": str(path), "frame_skip": 2},
        "initial": {"qpos": [-0.5], "std": 1e-3}, "estimators": {"ekf": {}, "ukf": {}},
        "simulation": {"duration": 0.6, "runs": 8}, "process_noise": {"density": {"*.vel": 1e-4}},
    }  # fmt: skip


def seen(data, runs):
    prepared = setup.build(Scenario.model_validate(data))
    return contact.seen(prepared, trajectory(prepared, runs).x, runs), prepared.times


def test_the_touch_down_of_a_falling_ball_is_when_it_has_fallen_that_far(ball):
    found, times = seen(ball, range(8))
    assert found is not None
    down = found.events[..., EVENTS.index("touch-down")]
    first = times[down.argmax(axis=0)]
    # Height 0.4 m ± 3 mm and speed ± 3 mm/s (3σ, and the process noise 4 mm/s) are ± 3 ms; the
    # instant is the first of a grid of 4 ms.
    assert (abs(first - np.sqrt(2 * 0.4 / 9.81) - 0.002) < 0.008).all()
    assert not found.touching[: down.argmax(axis=0).min()].any()


def test_other_events_and_steps_give_other_phases(ball):
    shares = []
    for section in ({}, {"steps": 0}, {"events": ["lift-off"]}, {"events": ["limit"]}):
        found, _ = seen(ball | {"contact": section}, range(3))
        assert found is not None
        shares.append(found.phases[..., 2].mean())
    assert shares[0] > shares[1] > 0
    assert shares[0] > shares[2]
    assert shares[3] == 0


def test_a_size_that_is_drawn_per_run_moves_the_touch_down(ball):
    draw = {"truth": {"draw": {"geom_size.foot_geom": {"relative_std": 0.1}}}}
    path = ball["model"]["path"]
    text = HOPS.replace('<geom size=".1"', '<geom name="foot_geom" size=".1"')
    with open(path, "w", encoding="utf-8") as file:
        file.write(text)
    data = ball | draw | {"initial": {"qpos": [-0.5], "std": 1e-9}}
    prepared = setup.build(Scenario.model_validate(data))
    x = trajectory(prepared, range(8)).x
    found = contact.seen(prepared, x, range(8))
    assert found is not None
    gap = x[..., 0] + 1  # of the centre above the floor
    at = found.events[..., EVENTS.index("touch-down")].argmax(axis=0)
    radius = gap[at, np.arange(8)]
    assert np.ptp(radius) > 0.02  # of 0.1 ± 0.01
    again = contact.seen(prepared, x[:, 5:], range(5, 8))
    assert again is not None
    np.testing.assert_array_equal(again.events, found.events[:, 5:])


def test_a_robot_without_contacts(tmp_path):
    path = tmp_path / "spin.xml"
    path.write_text(SPIN, encoding="utf-8")
    data = {
        "name": "spin",
        "model": {"path": str(path)},
        "simulation": {"duration": 0.1, "runs": 2},
    }
    found, _ = seen(data, range(2))
    assert found is None
    for section, said in (
        ({"phases": True}, "phases is true"),
        ({"slip": 0.1}, "slip is 0.1"),
        ({"events": ["limit"]}, r'events is \["limit"\]'),
    ):
        with pytest.raises(ScenarioError, match=rf"contact\.{said}, but no two geoms .* leave it"):
            setup.build(Scenario.model_validate(data | {"contact": section}))
    path.write_text(SPIN.replace('type="hinge"', 'type="hinge" range="-1 1"'), encoding="utf-8")
    found, _ = seen(data | {"contact": {"events": ["limit"]}}, range(2))
    assert found is not None


def test_every_table_has_the_phases(ball, tmp_path):
    out = tmp_path / "out"
    ball["simulation"] = {"duration": 0.4, "runs": 4}
    results = experiment.run(Scenario.model_validate(ball), out=out, keep="summary", batch_size=3)
    numbers = results.to_dict()["estimators"]["ekf"]["phases"]
    assert list(numbers) == ["flight", "stance", "event"]
    np.testing.assert_allclose(sum(p["share"] for p in numbers.values()), 1)
    comparison = compare_stores([out])
    (contest,) = json.loads(render(comparison, "json"))["contests"]
    assert contest["estimators"]["ekf"]["phases"] == numbers
    for text in (str(results), render(comparison, "text")):
        assert all(sum(name in line for line in text.splitlines()) >= 2 for name in numbers)
    assert render(comparison, "csv").count("anees_over_n_flight") == 2
    page = write_report([out], video=False).read_text(encoding="utf-8")
    assert 'id="table-phases"' in page
    # The phases divide the time: averages weighted by their instants are those of the whole run.
    record = results.records["ukf"]
    steps = record["phase_steps"]
    total = np.nansum(record["mse_by_phase"] * steps[..., None], axis=1)
    np.testing.assert_allclose(total / steps.sum(axis=1)[:, None], record["mse"], rtol=1e-12)
    off = ball | {"contact": {"phases": False}}
    results = experiment.run(Scenario.model_validate(off))
    assert results.phases("ekf") == ()
    assert "flight" not in str(results)


def test_the_events_of_a_stored_run_are_those_of_its_truth(ball, tmp_path):
    for observe in ("truth", "estimate"):
        data = ball | {
            "simulation": {"duration": 0.5, "runs": 3}, "control": {"observe": observe},
            "estimators": {"ekf": {}},
        }  # fmt: skip
        experiment.run(Scenario.model_validate(data), out=tmp_path / observe, keep="diagonal")
        (entry,) = load([tmp_path / observe])
        found, times = seen(data, range(3))
        assert found is not None
        marks = events(entry, [2])[0]
        assert "touch-down" in marks
        for kind, at in marks.items():
            np.testing.assert_array_equal(at, times[found.events[:, 2, EVENTS.index(kind)]])
        assert marks.keys() == found.times(times, 2).keys()
    plots.plot(plots.Paper([entry], run=2), "error", tmp_path / "error.svg")
    assert "touch-down" in (tmp_path / "error.svg").read_text(encoding="utf-8")


@pytest.fixture
def stored(ball, tmp_path):
    """Both estimators on the ball, with traces, in two batches."""
    out = tmp_path / "stored"
    data = Scenario.model_validate(ball | {"simulation": {"duration": 0.5, "runs": 5}})
    experiment.run(data, out=out, keep="diagonal", batch_size=3)
    return load([out])


def test_nees_around_the_touch_downs_is_the_mean_over_the_events_and_then_over_the_runs(
    stored, tmp_path
):
    entry = stored[1]
    found = around.nees(entry, "touch-down")
    nees = entry.group["nees"].values / entry.source.n
    expected = np.full((5, around.BEFORE + around.AFTER + 1), np.nan)
    for run, marks in enumerate(events(entry, range(5))):
        at = np.searchsorted(entry.source.times, marks["touch-down"])
        for k, lag in enumerate(range(-around.BEFORE, around.AFTER + 1)):
            near = [nees[run, i + lag] for i in at if 0 <= i + lag < nees.shape[1]]
            expected[run, k] = np.mean(near) if near else np.nan
    np.testing.assert_allclose(found.mean, np.nanmean(expected, axis=0), rtol=1e-12)
    first = positive_mean_interval(expected[:, 0])
    np.testing.assert_allclose([found.low[0], found.high[0]], [first.low, first.high], rtol=1e-9)
    figure = plots._touch_down(plots.Paper(stored))
    np.testing.assert_array_equal(figure.axes[0].lines[3].get_ydata(), found.mean)
    plots.plot(plots.Paper(stored), "touch-down", tmp_path / "touch-down.svg")


def test_the_report_marks_the_events_of_the_run_that_is_drawn(stored, tmp_path):
    page = write_report([stored[0].source.folder], tmp_path / "page.html", video=False)
    text = page.read_text(encoding="utf-8")
    assert "▼ touch-down" in text
    assert "■ slip" not in text
    marked = re.search(r'<script type="application/json" id="page-data">(.*?)</script>', text)
    assert marked
    data = json.loads(marked[1])
    for run, expected in enumerate(events(stored[0], range(5))):
        for entry in stored:
            shown = data["runs"][str(run)][entry.key]["events"]
            assert shown.keys() == expected.keys()
            for kind, packed in shown.items():
                times = np.frombuffer(base64.b64decode(packed["bdata"]), "<f4")
                np.testing.assert_allclose(times, expected[kind], rtol=1e-6)
    (kinds,) = {
        tuple(t["meta"]["event"] for t in d["traces"] if "event" in (t.get("meta") or {}))
        for name, d in data["drawings"].items()
        if name.startswith("error-") or name == "run-nees"
    }
    assert kinds == 2 * EVENTS
