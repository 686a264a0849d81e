import re

import numpy as np
import pytest

from estbench.errors import EstbenchError, StoreError
from estbench.experiment import recording, setup
from estbench.report.figures import sensors as sensor_picture
from estbench.scenario.load import resolve
from estbench.sensors.delivery import divided

pytest.importorskip("matplotlib")
from matplotlib.backends.backend_agg import FigureCanvasAgg


@pytest.fixture(scope="module")
def delayed():
    return setup.build(resolve("quadrotor_delayed", duration=1.0))


def test_a_record_is_what_the_run_saw(delayed):
    records = {r.channel.name: r for r in sensor_picture.record(delayed, 0.5, 3)}
    assert list(records) == ["accel", "gyro", "position", "height", "compass"]
    trajectory = recording.trajectory(delayed, [3])
    position = records["position"]
    np.testing.assert_allclose(position.taken, [0.1, 0.2, 0.3, 0.4, 0.5])
    np.testing.assert_allclose(position.arrived, position.taken + 0.08)
    came = [
        d.y[0] for a in trajectory.deliveries for d in divided(a) if d.channels == ("position",)
    ]
    np.testing.assert_array_equal(position.measured, came[:5])
    np.testing.assert_allclose(position.times, 0.005 * np.arange(1, 101))
    np.testing.assert_array_equal(position.true, trajectory.x[1:101, 0, :3])
    assert len(position.lost) == 0
    height = records["height"]
    due = np.round(np.concatenate([height.taken, height.lost]) / 0.04).astype(int)
    assert sorted(due) == list(range(1, 13))


def test_an_attitude_is_drawn_as_a_rotation():
    prepared = setup.build(resolve("quadrotor", duration=0.4))
    attitude = sensor_picture.record(prepared, 3.0)[-1]
    assert attitude.channel.name == "attitude"
    assert attitude.true.shape == (80, 3)
    np.testing.assert_allclose(attitude.true[0], 0.0, atol=1e-15)
    assert np.abs(attitude.measured).max() < 0.3


def test_the_picture_has_a_panel_an_axis(delayed):
    figure = sensor_picture.draw(sensor_picture.record(delayed, 0.5), "title")
    titles = [ax.get_title(loc="left") for ax in figure.axes]
    assert titles[0] == "accel.x  (accelerometer, 200 Hz)"
    assert titles[1:3] == ["accel.y", "accel.z"]
    assert titles[6] == "position.x  (framepos, 10 Hz, 80 ms late)"
    assert re.fullmatch(r"height\.z  \(framepos, 25 Hz(, \d+ lost)?\)", titles[9])
    assert len(titles) == 3 + 3 + 3 + 1 + 3
    key = figure.get_suptitle()
    assert key.startswith("title: true (lines) and measured (points); thin lines lead to the arri")
    # The time is told wherever the panels below have another width.
    told = [bool(ax.get_xlabel()) for ax in figure.axes]
    assert told == [False] * 6 + [True] * 3 + [True] + [True] * 3
    assert figure.axes[0].get_ylabel() == "m/s²"
    assert all(ax.get_xlim() == (0.0, pytest.approx(0.5)) for ax in figure.axes)


WORDY = "{noise=0.1, rate=50.0, latency=0.03, latency_std=0.01, dropout=0.2, of=['accel', 'gyro']}"


def test_no_words_overlap_and_several_sensors_keep_their_units():
    overrides = [f"channels.imu={WORDY}", "channels.position.axes=[1]", "channels.attitude.rate=25"]
    prepared = setup.build(resolve("quadrotor", duration=1.0, overrides=overrides))
    figure = sensor_picture.draw(sensor_picture.record(prepared, 0.5), "a scenario")
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    words = [w for ax in figure.axes for w in (ax._left_title, ax.xaxis.label, ax.yaxis.label)]
    words = [w for w in (*words, figure._suptitle) if w.get_text()]
    boxes = [w.get_window_extent(renderer) for w in words]
    for i, box in enumerate(boxes):
        assert figure.bbox.x0 <= box.x0 < box.x1 <= figure.bbox.x1, words[i].get_text()
        assert not [o for o, b in zip(words, boxes) if o is not words[i] and b.overlaps(box)]
    imu = [ax for ax in figure.axes if "imu" in ax.get_title(loc="left")]
    said = [" ".join(ax.get_title(loc="left").split()) for ax in imu]
    assert re.fullmatch(
        r"accel\.x \(imu, accelerometer \+ gyro, 50 Hz, 30 ± 10 ms late, \d+ lost\)", said[0]
    )
    assert [ax.get_ylabel() for ax in imu] == ["m/s²", "rad/s"]


def test_a_reading_that_is_taken_after_the_picture_ends_is_not_lost():
    overrides = ["channels.cart_encoder={rate=10.0, jitter=0.04}"]
    prepared = setup.build(resolve("cartpole", duration=2.0, overrides=overrides))
    runs = [sensor_picture.record(prepared, 1.0, run)[0] for run in range(6)]
    assert any(len(r.taken) == 9 for r in runs)  # the tenth is taken later in some runs
    assert not any(len(r.lost) for r in runs)


def test_nothing_to_draw(delayed):
    with pytest.raises(EstbenchError, match=r"--seconds is 0\.001; use at least 0\.005, one step"):
        sensor_picture.record(delayed, 0.001)


@pytest.mark.parametrize("name", ["a.png", "a.svg"])
def test_the_file(delayed, tmp_path, name):
    sensor_picture.write(delayed, tmp_path / name, 0.2)
    assert (tmp_path / name).stat().st_size > 5000


def test_what_cannot_be_written(delayed, tmp_path, monkeypatch):
    monkeypatch.delattr(sensor_picture, "record")  # it is refused before anything is simulated
    with pytest.raises(EstbenchError, match=r"'.*a\.gif' is no picture; end it in \.png"):
        sensor_picture.write(delayed, tmp_path / "a.gif")
    with pytest.raises(
        StoreError, match=r"a\.png cannot be written: there is no folder .*nowhere; make"
    ):
        sensor_picture.write(delayed, tmp_path / "nowhere" / "a.png", 0.1)
