"""What a step's updates say row by row; a late reading says what it adds to those of its time."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from estbench.estimators.kf import KF
from estbench.estimators.protocol import Innovation
from estbench.inference.fusion import Delays, Fusion
from estbench.inference.inbox import Inbox
from estbench.inference.latest import LatestInnovations
from estbench.inference.run_subset import ALL
from estbench.models.linear import LinearModel
from estbench.sensors.clock import Event
from estbench.sensors.delivery import Delivery
from estbench.sensors.timing import Instant
from estbench.spaces.manifold import Manifold
from tests.helpers import ChannelModel, random_cov

SPACES = {"a": Manifold.euclidean(1), "b": Manifold.euclidean(2, ["x", "y"])}
ROWS = 3


def innovation(residual, nis, dof, rows=ROWS):
    """The same in all rows."""
    m = len(residual)
    v = np.tile(np.asarray(residual, float), (rows, 1))
    S = np.tile(np.eye(m), (rows, 1, 1))
    return Innovation(v, S, v, np.full(rows, float(nis)), np.full(rows, dof))


@pytest.mark.parametrize("revised", [False, True])
def test_a_step_is_told_by_channel_and_row(revised):
    log = LatestInnovations(SPACES, ROWS, revised)
    mask = np.array([[True], [False], [True]])
    masked = replace(innovation([7], 0.5, 1), nis=np.array([0.5, 0, 0.5]), dof=np.array([1, 0, 1]))
    for number in range(2):
        log.begin()
        k = 2 * number
        log.clear(k, ALL)
        log.put(k, 0, ("b",), innovation([1, 2], 3, 2), None, ALL)
        log.settle(0)
        log.clear(k + 1, ALL)
        log.put(k + 1, 0, ("a",), masked, mask, ALL)
        log.settle(0)
        np.testing.assert_array_equal(log.innovation, [[7, 1, 2], [0, 1, 2], [7, 1, 2]])
        np.testing.assert_array_equal(log.nis, [3.5, 3, 3.5])
        np.testing.assert_array_equal(log.dof, [3, 2, 3])
    log.begin()
    log.settle(0)
    assert not log.innovation.any()
    assert not log.nis.any()
    assert not log.dof.any()


@pytest.mark.parametrize("revised", [False, True])
def test_of_two_events_of_a_step_the_last_innovation_is_shown_and_nis_is_the_sum(revised):
    log = LatestInnovations(SPACES, ROWS, revised)
    for k, value in enumerate((1.0, 5.0)):
        log.clear(k, ALL)
        log.put(k, 0, ("b",), innovation([value, value], value, 2), None, ALL)
        log.settle(0)
    np.testing.assert_array_equal(log.innovation, [[0, 5, 5]] * ROWS)
    np.testing.assert_array_equal(log.nis, [6] * ROWS)
    np.testing.assert_array_equal(log.dof, [4] * ROWS)


def test_a_late_reading_is_told_by_what_it_adds():
    log = LatestInnovations(SPACES, ROWS, revised=True)
    for k in range(2):  # `b` is on time at both events
        log.begin()
        log.clear(k, ALL)
        log.put(k, 0, ("b",), innovation([1, 2], 2 + k, 2), None, ALL)
        log.settle(0)
    # `a` of the first event comes to row 2 during the third, where `b` comes to all: the row is
    # updated again, twice in the rows.
    log.begin()
    rows = np.array([2, 2])
    log.clear(0, rows)
    log.put(0, 0, ("a", "b"), innovation([9, 8, 8], 6.5, 3, rows=2), None, rows)
    log.clear(1, rows)
    log.put(1, 0, ("b",), innovation([4, 4], 2.5, 2, rows=2), None, rows)
    log.clear(2, ALL)
    log.put(2, 0, ("b",), innovation([5, 6], 1, 2), None, ALL)
    log.settle(0)
    np.testing.assert_array_equal(log.nis, [1, 1, 1 + 6.5 - 2])
    np.testing.assert_array_equal(log.dof, [2, 2, 3])
    np.testing.assert_array_equal(log.innovation, [[0, 5, 6], [0, 5, 6], [9, 5, 6]])


def test_readings_that_are_fused_again_did_not_come_in_this_step():
    log = LatestInnovations(SPACES, ROWS, revised=True)
    log.clear(0, ALL)
    log.put(0, 0, ("b",), innovation([1, 2], 2, 2), None, ALL)
    log.settle(0)
    log.begin()
    log.clear(0, ALL)
    log.put(0, 0, ("a", "b"), innovation([9, 8, 8], 6.5, 3), None, ALL)
    log.settle(0)
    np.testing.assert_array_equal(log.innovation, [[9, 0, 0]] * ROWS)
    np.testing.assert_array_equal(log.nis, [4.5] * ROWS)
    np.testing.assert_array_equal(log.dof, [1] * ROWS)
    # A second reading of `b` for the same time is a second layer.
    log.begin()
    log.clear(0, ALL)
    log.put(0, 0, ("a", "b"), innovation([9, 8, 8], 6.5, 3), None, ALL)
    log.put(0, 1, ("b",), innovation([3, 4], 0.25, 2), None, ALL)
    log.settle(0)
    np.testing.assert_array_equal(log.innovation, [[0, 3, 4]] * ROWS)
    np.testing.assert_array_equal(log.nis, [0.25] * ROWS)
    np.testing.assert_array_equal(log.dof, [2] * ROWS)


def test_what_was_only_gathered_is_not_told():
    log = LatestInnovations(SPACES, ROWS, revised=True)
    log.clear(0, ALL)
    log.put(0, 0, ("b",), innovation([1, 2], 0, 0), None, ALL)
    log.settle(0)
    assert not log.innovation.any()
    assert not log.dof.any()


def test_an_estimator_without_residuals_has_nis():
    for revised in (False, True):
        log = LatestInnovations(SPACES, ROWS, revised)
        log.clear(0, ALL)
        nothing = np.empty((ROWS, 0))
        bare = replace(innovation([1, 2], 3, 2), residual=nothing, cov=nothing, white=nothing)
        log.put(0, 0, ("b",), bare, None, ALL)
        log.settle(0)
        assert not log.innovation.any()
        np.testing.assert_array_equal(log.nis, [3] * ROWS)


def test_a_row_that_begins_anew_has_none():
    log = LatestInnovations(SPACES, ROWS, revised=True)
    log.clear(0, ALL)
    log.put(0, 0, ("b",), innovation([1, 2], 3, 2), None, ALL)
    log.settle(0)
    log.forget(np.array([1]))
    np.testing.assert_array_equal(log.innovation, [[0, 1, 2], [0, 0, 0], [0, 1, 2]])
    np.testing.assert_array_equal(log.nis, [3, 0, 3])
    np.testing.assert_array_equal(log.dof, [2, 0, 2])


def two_channels() -> Any:
    """A linear model with a channel of one component and one of two, of independent noise."""
    rng = np.random.default_rng(0)
    A, R = np.array([[1.0, 0.1], [-0.1, 0.9]]), random_cov(rng, 3)
    R[0, 1:] = R[1:, 0] = 0.0
    model = LinearModel(A, rng.standard_normal((3, 2)), 0.1 * np.eye(2), R)
    return ChannelModel(model, {"a": [0], "b": [1, 2]})


def test_the_nis_of_a_late_reading_is_the_joint_one_less_that_of_the_others():
    """Against the joint update by hand; what a late reading adds is its conditional NIS."""
    rng = np.random.default_rng(1)
    kf, y = KF(two_channels()), rng.standard_normal((3, ROWS, 3))
    mean, cov = rng.standard_normal((ROWS, 2)), random_cov(rng, 2, ROWS)
    log = LatestInnovations(SPACES, ROWS, revised=True)
    fusion = Fusion(kf, kf.init(mean, cov), Inbox(SPACES), Delays(window=5), log)
    u, late = np.zeros((ROWS, 0)), np.array([False, True, True])
    found = []
    for k in range(3):
        instant = Instant(k * 1.0, k + 1.0, 1, ("a", "b"), True, k + 1)
        arrived = [Delivery(("b",), k + 1, y[k][:, 1:], None, k + 1)]
        if k != 1:
            arrived.insert(0, Delivery(("a",), k + 1, y[k][:, :1], None, k + 1))
        if k == 2:  # `a` of the second event comes now, to two rows
            arrived.append(Delivery(("a",), 2, y[1][:, :1], late, 2))
        log.begin()
        log.settle(fusion.step(Event(k + 1, instant), u, arrived))
        found.append((log.nis.copy(), log.dof.copy(), log.innovation.copy()))
    belief = kf.predict(kf.init(mean, cov), u, 0.0, 1.0)
    belief, _ = kf.update(belief, y[0], u, 1.0, ("a", "b"))
    prior = kf.predict(belief, u, 1.0, 1.0)
    without, only = kf.update(prior, y[1][:, 1:], u, 2.0, ("b",))
    with_late, joint = kf.update(prior, y[1], u, 2.0, ("a", "b"))
    np.testing.assert_allclose(found[1][0], only.nis)
    np.testing.assert_array_equal(found[1][1], [2] * ROWS)
    last, told = {}, {}
    for name, posterior in (("late", with_late), ("never", without)):
        at_three = kf.predict(posterior, u, 2.0, 1.0)
        _, last[name] = kf.update(at_three, y[2], u, 3.0, ("a", "b"))
        told[name] = last[name].nis + (joint.nis - only.nis if name == "late" else 0.0)
    np.testing.assert_allclose(found[2][0], np.where(late, told["late"], told["never"]), rtol=1e-9)
    np.testing.assert_array_equal(found[2][1], np.where(late, 4, 3))
    residual = np.where(late[:, None], last["late"].residual, last["never"].residual)
    np.testing.assert_allclose(found[2][2], residual, atol=1e-12)
    # `a` has noise of its own: its conditional NIS is that of an update after the one by `b`.
    _, after = kf.update(without, y[1][:, :1], u, 2.0, ("a",))
    np.testing.assert_allclose(joint.nis - only.nis, after.nis, rtol=1e-9)
