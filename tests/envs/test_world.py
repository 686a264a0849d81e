# pyright: reportOptionalMemberAccess=false, reportArgumentType=false
# pyright: reportOptionalSubscript=false, reportGeneralTypeIssues=false
import numpy as np
import pytest

from estbench.envs.world import World, prepare
from estbench.errors import EstimatorError
from estbench.inference.live import LiveFilter
from estbench.sensors.clock import Event
from estbench.sensors.delivery import Delivery
from estbench.sensors.timing import Instant
from estbench.spaces.manifold import Manifold
from tests.helpers import ESTIMATORS

SETTINGS = {"particle": {"size": 50}, "enkf": {"size": 20}}


def world(name, rows, scenario="pendulum", **overrides):
    table = {"type": name, **SETTINGS.get(name, {})}
    sets = [f"{k.replace('__', '.')}={v}" for k, v in overrides.items()]
    return World(prepare(scenario, table, None, sets), rows)


def begin(w, runs, rows=None):
    """Episodes begin: in all rows, or in some, those are the runs."""
    w.reset(np.arange(w.rows) if rows is None else np.array(rows), 0, list(runs))


def drive(w, steps, start=0):
    out = []
    for k in range(start, start + steps):
        u = np.full((w.rows, w.u.shape[1]), 0.3 * np.sin(0.2 * k))
        w.step(u)
        f = w.filter
        out.append([w.x.copy(), f.estimate.copy(), f.cov.copy(), f.nis.copy()])
    return out


@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_row_starts_anew_among_others_as_it_would_alone(name):
    try:
        mixed, alone, company = world(name, 3), world(name, 1), world(name, 3)
    except EstimatorError as error:
        pytest.skip(str(error))  # not for MuJoCo models
    for w in (mixed, company):
        begin(w, [1, 2, 3])
        drive(w, 5)
    begin(mixed, [9], [1])
    begin(alone, [9])
    a, b, c = drive(mixed, 6), drive(alone, 6), drive(company, 6)
    for here, single, rest in zip(a, b, c):
        np.testing.assert_array_equal(here[0][1], single[0][0])  # truth, to the last bit
        np.testing.assert_array_equal(here[0][[0, 2]], rest[0][[0, 2]])
        for x, y, z in zip(here[1:], single[1:], rest[1:]):
            np.testing.assert_allclose(x[1], y[0], rtol=0, atol=1e-9)
            np.testing.assert_allclose(x[[0, 2]], z[[0, 2]], rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_channels_of_different_rates_arrive_by_row(name):
    rates = {"channels__encoder__rate": 50.0, "channels__gyro__rate": 25.0}
    mixed, alone = world(name, 2, **rates), world(name, 1, **rates)
    begin(mixed, [1, 2])
    drive(mixed, 3)
    begin(mixed, [9], [0])  # the rows are out of phase now
    begin(alone, [9])
    dofs = []
    for k in range(8):
        a, b = drive(mixed, 1, k)[0], drive(alone, 1, k)[0]
        np.testing.assert_array_equal(a[0][0], b[0][0])
        for x, y in zip(a[1:], b[1:]):
            np.testing.assert_allclose(x[0], y[0], atol=1e-12)
        dofs.append(mixed.filter.dof.tolist())
    assert dofs == [[0, 4], [1, 0], [0, 1], [4, 0], [0, 4], [1, 0], [0, 1], [4, 0]]


def test_rates_above_the_control_rate_are_all_used():
    w = world("ekf", 1, model__frame_skip=4, channels__encoder__rate=50.0, channels__gyro__rate=100)
    begin(w, [1])
    w.step(np.zeros((1, 1)))
    assert w.filter.dof.tolist() == [2 * 1 + 4 * 3]
    assert w.simulator.clocks.elapsed.tolist() == [4]


@pytest.mark.parametrize("scenario", ["pendulum", "quadrotor"])
def test_the_filter_is_consistent(scenario):
    w = world("ekf", 150, scenario)
    begin(w, range(150))
    u = np.repeat(w.setup.plant.u0[None], 150, axis=0)
    nees = []
    for _ in range(30):
        w.step(u)
        info = w.info()
        nees.append(info["nees"])
        assert info["error"].shape == (150, w.setup.space.n)
    mean = np.mean(nees, axis=0) / w.setup.space.n
    assert abs(mean.mean() - 1) < 5 * mean.std() / np.sqrt(150) + 0.05
    assert not info["diverged"].any()


def test_rows_outside_a_mask_earn_nothing_and_change_no_other():
    w, other = world("ukf", 2), world("ukf", 2)
    for each in (w, other):
        begin(each, [1, 2])
        drive(each, 2)
    reward, *_ = w.step(np.zeros((2, 1)), np.array([False, True]))
    whole, *_ = other.step(np.zeros((2, 1)))
    assert reward.tolist() == [0.0, whole[1]]
    np.testing.assert_array_equal(w.x[1], other.x[1])
    np.testing.assert_array_equal(w.filter.estimate[1], other.filter.estimate[1])
    begin(w, [1], [0])  # as it must before it takes part again
    assert w.elapsed.tolist() == [0, 3]
    begin(other, [1], [0])
    drive(w, 1)
    drive(other, 1)
    np.testing.assert_array_equal(w.x[0], other.x[0])


LATE = {"channels__encoder__rate": 12.5}  # every 8 steps; the gyro every step


@pytest.mark.parametrize("name", ["ekf", "ukf", "kf"])
@pytest.mark.parametrize("std", [0.0, 0.01])
def test_late_readings_are_fused_exactly_once_they_are_there(name, std):
    late = {"channels__encoder__latency": 0.03, "channels__encoder__latency_std": std}
    on_time, delayed = world(name, 3, **LATE), world(name, 3, **LATE, **late)
    apart = []
    for w in (on_time, delayed):
        begin(w, [1, 2, 3])
    for k in range(40):
        a, b = drive(on_time, 1, k)[0], drive(delayed, 1, k)[0]
        np.testing.assert_array_equal(a[0], b[0])
        apart.append(np.abs(a[1] - b[1]).max())
        if k == 23:  # one row starts anew while a reading is on its way
            for w in (on_time, delayed):
                begin(w, [9], [1])
    due = np.arange(7, 40, 8)
    assert (np.array(apart)[due] > 1e-7).all()  # not there yet
    caught_up = [k for k in range(40) if k % 8 == 6]
    assert max(np.array(apart)[caught_up]) < 1e-9


def test_naive_handling_of_late_readings_is_overconfident():
    late = {"channels__encoder__latency": 0.2, "channels__gyro__rate": 5.0}
    mean = {}
    for handling in ("exact", "naive"):
        w = world("ekf", 60, **late, filter__delays=f"'{handling}'")
        begin(w, range(60))
        drive(w, 60)
        nees = [w.info()["nees"] for _ in drive(w, 20, 60)]
        mean[handling] = np.mean(nees) / 2
    assert 0.8 < mean["exact"] < 1.25
    assert mean["naive"] > 3


class Breaks:
    """A filter whose second row becomes NaN at the third prediction."""

    def __init__(self, space):
        self.space = space

    def init(self, mean, cov):
        return mean, cov, np.zeros(len(mean), int)

    def predict(self, belief, u, t, dt):
        mean, cov, count = belief
        mean = mean + 1.0
        mean[1:] = np.where(count[1:, None] >= 2, np.nan, mean[1:])
        return mean, cov, count + 1

    def update(self, belief, y, u, t, channels=None, mask=None):
        raise KeyError("no update")

    def mean(self, belief):
        return belief[0]

    def cov(self, belief):
        return belief[1]


def test_a_failed_row_keeps_its_last_estimate_says_so_and_can_start_anew():
    space, every = Manifold.euclidean(2), np.arange(2)
    live = LiveFilter(Breaks(space), space, {"y": Manifold.euclidean(1)}, 2)
    mean, cov, u = np.zeros((2, 2)), np.repeat(np.eye(2)[None], 2, axis=0), np.zeros((2, 0))
    event = Event(1, Instant(0.0, 0.1, 1, (), True, 1))
    live.start(every, mean, cov)

    def step(*arrived):
        live.begin()
        live.step(event, u, arrived)
        live.settle()

    for _ in range(4):
        step()
    info = live.info(np.zeros((2, 2)))
    assert info["diverged"].tolist() == [False, True]
    np.testing.assert_array_equal(info["estimate"], [[4, 4], [2, 2]])
    assert info["nees"].tolist() == [32.0, np.inf]
    assert info["nis"].tolist() == [0, 0]
    live.start(every[1:], mean, cov)
    step()
    np.testing.assert_array_equal(live.estimate, [[5, 5], [1, 1]])
    assert not live.failed.any()
    with pytest.raises(EstimatorError, match=r"Breaks raised KeyError: 'no update' \(.*in update"):
        step(Delivery(("y",), 1, np.zeros((2, 1)), None, 1))


def test_infos_are_copies():
    w = world("ekf", 2)
    begin(w, [1, 2])
    before = w.info()
    kept = {k: v.copy() for k, v in before.items()}
    drive(w, 3)
    for k, v in before.items():
        np.testing.assert_array_equal(v, kept[k])
