from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("PIL")

from PIL import Image

from estbench.errors import EstbenchError, StoreError
from estbench.report.rendering import replay, video
from estbench.report.rendering.chart import Chart
from tests.report.conftest import needs_gl


@pytest.fixture(scope="module")
def run():
    return replay.replay("pendulum", 1, "ekf", ["simulation.duration=1.0"])


def test_a_stored_run_has_the_covariance_of_its_simulation(entries):
    entry = entries("two")[1]
    stored, again = replay.of_entry(entry, 3), replay.simulated(entry.source.scenario, 3, "ukf")
    assert stored.correlated
    np.testing.assert_allclose(stored.estimate, again.estimate, atol=1e-9)
    diagonal = np.sqrt(np.diagonal(stored.cov, axis1=1, axis2=2))
    np.testing.assert_allclose(diagonal, entry.group["std"].values[3], rtol=1e-6)


def test_a_run_that_cannot_be_repeated_has_variances_only(entries, monkeypatch):
    monkeypatch.setattr(replay, "_again", lambda *_: None)
    entry = entries("two")[0]
    run = replay.of_entry(entry, 3)
    assert not run.correlated
    std = entry.group["std"].values[3]
    np.testing.assert_allclose(run.cov[5], np.diag(std[5] ** 2))


def test_a_summary_is_simulated_again(entries):
    (entry,) = entries("bare")
    run = replay.of_entry(entry, 4)
    settled = entry.source.settled
    assert run.nees[settled].mean() == pytest.approx(entry.record["anees"][4], rel=1e-6)


def test_frames_are_in_step():
    times = np.linspace(0, 2, 201)
    steps = video.frame_steps(times, 25)
    assert len(steps) == 51
    np.testing.assert_allclose(times[steps], np.arange(51) / 25, atol=1e-12)
    np.testing.assert_array_equal(video.frame_steps(times, 25, speed=2.0), steps[::2])
    uneven = np.array([0, 0.09, 0.21, 0.5])
    np.testing.assert_array_equal(video.frame_steps(uneven, 10), [0, 1, 1, 2, 2, 3])
    with pytest.raises(EstbenchError, match="frames are too many"):
        video.frame_steps(times, 25, speed=1e-4)


def test_the_charts_cursor_is_at_the_frames_time(run):
    chart = Chart(run, 320, 60)
    for step in (0, 40, 100):
        picture = chart.draw(step).astype(int)
        middle = picture[(chart.top + chart.bottom) // 2]
        orange = (middle[:, 0] - middle[:, 2] > 60).nonzero()[0]
        assert orange.mean() == pytest.approx(float(chart.x(run.times[step])), abs=1.5)


@pytest.mark.parametrize("width", [64, 320, 640])
def test_the_charts_title_leaves_room_for_the_time(run, width):
    for label in ("ekf", "an_estimator_with_a_long_name"):
        chart = Chart(replace(run, label=label), width, 60)
        title, moment = (
            chart._font.getlength(t) for t in (chart._title(), "t = 10.00 s   NEES/n = 0.123")
        )
        assert title == 0 or title + moment < 2 * (chart.right - chart.left)
    assert Chart(run, 640, 60)._title() == "pendulum: ekf, run 1 (grey: 95%)"


@needs_gl
@pytest.mark.parametrize("kind", ["mp4", "gif"])
def test_a_film_has_its_frames(run, tmp_path, kind):
    if kind == "mp4":
        pytest.importorskip("imageio_ffmpeg")
    look = video.Look(96, 64, fps=10)
    path = tmp_path / f"film.{kind}"
    assert video.write(run, path, look) == 11
    if kind == "gif":
        with Image.open(path) as image:
            assert image.size == (96, 64 + look.strip)
            assert getattr(image, "n_frames", 1) > 5  # identical neighbours are joined
    else:
        import imageio_ffmpeg

        count, seconds = imageio_ffmpeg.count_frames_and_secs(str(path))
        assert count == 11
        assert seconds == pytest.approx(1.1, abs=0.02)


@needs_gl
def test_one_frame(run, tmp_path):
    look = video.Look(96, 64)
    assert video.write(run, tmp_path / "a.png", look, at=0.5) == 1
    (expected,) = video.frames(run, np.array([50]), look)
    with Image.open(tmp_path / "a.png") as image:
        np.testing.assert_array_equal(np.asarray(image), expected)


def test_bad_input(run, store, tmp_path):
    look = video.Look()
    with pytest.raises(EstbenchError, match=r"no such format; use \.mp4"):
        video.write(run, tmp_path / "a.avi", look)
    with pytest.raises(EstbenchError, match="give --at"):
        video.write(run, tmp_path / "a.png", look)
    with pytest.raises(EstbenchError, match="the run is from 0 to 1 s"):
        video.write(run, tmp_path / "a.png", look, at=2)
    with pytest.raises(StoreError, match="there is no folder"):
        video.write(run, tmp_path / "no" / "a.gif", look)
    for name, value in (("width", 65), ("height", 10), ("fps", 0), ("speed", -1)):
        with pytest.raises(EstbenchError, match=f"--{name} is"):
            video.Look(**{name: value})  # pyright: ignore[reportArgumentType]
    with pytest.raises(StoreError, match="no finished run 99; it has 12 runs, 0 to 11"):
        replay.replay(store("two"), 99)
    with pytest.raises(EstbenchError, match="numbered from 0"):
        replay.replay("pendulum", -1)
    with pytest.raises(EstbenchError, match="no estimator 'ukff'"):
        replay.replay("pendulum", 0, "ukff")


def test_the_chart_marks_stance_and_the_events_of_contact(run):
    touching = (run.times > 0.3 * run.times[-1]) & (run.times < 0.6 * run.times[-1])
    at = run.times[touching][[0, -1]]
    events = {"touch-down": at[:1], "lift-off": at[1:]}
    plain = Chart(run, 320, 80)
    marked = Chart(replace(run, touching=touching, events=events), 320, 80)
    changed = (plain.draw(0).astype(int) != marked.draw(0)).any(axis=-1)
    bar = changed[plain.bottom - 2].nonzero()[0]
    assert (bar[0], bar[-1]) == pytest.approx(plain.x(at), abs=3)
    assert len(bar) > 0.9 * np.ptp(plain.x(at))
    lines = changed[round(0.85 * plain.bottom + 0.15 * plain.top)].nonzero()[0]
    assert len(lines) > 0
    assert all(abs(plain.x(at) - column).min() < 2 for column in lines)
