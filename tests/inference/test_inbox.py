import numpy as np

from estbench.inference.inbox import Inbox
from estbench.sensors.delivery import Delivery
from estbench.spaces.manifold import Manifold

SPACES = {"a": Manifold.euclidean(1), "b": Manifold.euclidean(2)}
RUNS = 3


def delivery(channel, value, mask=None):
    y = np.full((RUNS, SPACES[channel].nx), float(value))
    return Delivery((channel,), 0, y, None if mask is None else np.array(mask, bool), 0)


def test_nothing_has_come():
    assert Inbox(SPACES).at(3) == []


def test_channels_of_one_instant_are_joined_in_their_order():
    inbox = Inbox(SPACES)
    inbox.add(4, delivery("b", 2))
    inbox.add(4, delivery("a", 1))
    (joint,) = inbox.at(4)
    assert joint.channels == ("a", "b")
    np.testing.assert_array_equal(joint.y, np.tile([1.0, 2.0, 2.0], (RUNS, 1)))
    assert joint.mask is None
    assert inbox.at(5) == []


def test_a_mask_is_one_of_components():
    inbox = Inbox(SPACES)
    inbox.add(4, delivery("a", 1))
    inbox.add(4, delivery("b", 2, [1, 0, 1]))
    (joint,) = inbox.at(4)
    np.testing.assert_array_equal(joint.mask, [[1, 1, 1], [1, 0, 0], [1, 1, 1]])


def test_parts_of_one_channel_that_come_one_by_one_are_one_reading():
    inbox = Inbox(SPACES)
    inbox.add(4, delivery("a", 1, [1, 0, 0]))
    np.testing.assert_array_equal(inbox.at(4)[0].mask, [[1], [0], [0]])
    inbox.add(4, delivery("a", 2, [0, 1, 0]))
    (joint,) = inbox.at(4)
    np.testing.assert_array_equal(joint.mask, [[1], [1], [0]])
    np.testing.assert_array_equal(joint.y[:2, 0], [1, 2])
    inbox.add(4, delivery("a", 3, [0, 0, 1]))
    (joint,) = inbox.at(4)
    assert joint.mask is None
    np.testing.assert_array_equal(joint.y[:, 0], [1, 2, 3])


def test_a_second_reading_of_a_run_opens_a_layer_and_loses_nothing():
    inbox = Inbox(SPACES)
    inbox.add(4, delivery("a", 1))
    inbox.add(4, delivery("a", 2, [0, 1, 1]))
    inbox.add(4, delivery("a", 3, [1, 0, 0]))
    inbox.add(4, delivery("b", 4))
    first, second = inbox.at(4)
    assert first.channels == ("a", "b")
    np.testing.assert_array_equal(first.y[:, 0], 1)
    assert second.channels == ("a",)
    assert second.mask is None
    np.testing.assert_array_equal(second.y[:, 0], [3, 2, 2])


def test_readings_that_overlap_in_some_runs_fill_as_few_layers_as_a_run_has_readings():
    inbox = Inbox(SPACES)
    inbox.add(4, delivery("a", 1, [1, 1, 0]))
    inbox.add(4, delivery("a", 2, [0, 1, 1]))
    inbox.add(4, delivery("a", 3, [1, 0, 1]))
    first, second = inbox.at(4)
    assert first.mask is None
    assert second.mask is None
    np.testing.assert_array_equal(first.y[:, 0], [1, 1, 2])
    np.testing.assert_array_equal(second.y[:, 0], [3, 2, 3])


def test_forgetting():
    inbox = Inbox(SPACES)
    for instant in range(5):
        inbox.add(instant, delivery("a", instant))
    inbox.at(1)
    inbox.forget(3)
    assert [len(inbox.at(k)) for k in range(5)] == [0, 0, 0, 1, 1]


def test_a_component_without_a_return_is_masked_and_zero():
    inbox = Inbox(SPACES)
    y = np.array([[1.0, np.inf], [2.0, 3.0], [np.inf, np.inf]])
    inbox.add(4, Delivery(("b",), 0, y, np.array([True, True, False]), 0))
    inbox.add(4, delivery("a", 5))
    (joint,) = inbox.at(4)
    np.testing.assert_array_equal(joint.mask, [[1, 1, 0], [1, 1, 1], [1, 0, 0]])
    np.testing.assert_array_equal(joint.y, [[5, 1, 0], [5, 2, 3], [5, 0, 0]])
