"""A smoother with a window keeps no more than that window, and gives what it gave of the whole."""

import gc

import numpy as np
import pytest

from estbench.estimators.beliefs import Gaussian
from estbench.estimators.protocol import windows
from estbench.experiment import recording, setup
from estbench.scenario.load import resolve
from estbench.smoothers.estimators import RTS

RUNS = range(2)


def test_windows_share_their_ends():
    times = [0.0, 0.1, 0.2, 0.3, 0.4, 0.5]
    found = list(windows(times, 0.2))
    assert [(w.start, w.stop) for w in found] == [(0, 3), (2, 5), (4, 6)]
    assert list(windows(times, None)) == [slice(0, 6)]
    assert [w.start for w in windows(times, 0.01)] == [0, 1, 2, 3, 4]  # at least one step each
    assert not list(windows([0.0], None))


def traces(window, robot="pendulum", base="ekf"):
    option = "" if window is None else f", window={window}"
    overrides = ["bound=false", f"estimators={{rts={{type='rts', base='{base}'{option}}}}}"]
    prepared = setup.build(resolve(robot, None, runs=2, duration=0.4, overrides=overrides))
    truth = recording.trajectory(prepared, RUNS)
    found = recording.estimated(prepared, "rts", RUNS, truth)
    assert found is not None
    return found[0]


@pytest.mark.parametrize("robot", ["pendulum", "quadrotor_delayed"])
def test_a_longer_window_knows_more(robot):
    whole, part, step = (traces(w, robot) for w in (None, 0.1, 1e-6))
    np.testing.assert_array_equal(traces(0.4, robot).mean, whole.mean)
    assert (part.std <= step.std + 1e-12).mean() > 0.95
    assert whole.std.mean() < part.std.mean() < step.std.mean()
    np.testing.assert_allclose(part.std[-1], whole.std[-1])  # the filter's


def test_no_more_than_a_window_is_kept(monkeypatch):
    most, original = [], RTS.smooth

    def counting(self, history):
        gc.collect()
        most.append(sum(isinstance(x, Gaussian) for x in gc.get_objects()))
        return original(self, history)

    monkeypatch.setattr(RTS, "smooth", counting)
    traces(None)
    whole = most.pop()
    traces(0.05)
    steps = 0.4 / 0.01
    assert len(most) == 8
    assert max(most) < whole - 0.7 * steps
