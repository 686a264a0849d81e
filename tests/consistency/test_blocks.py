import numpy as np
import pytest

from estbench.consistency.blocks import COUNT, Block, blocks, means, span


@pytest.mark.parametrize(("burn_in", "dt"), [(0.0, 0.01), (0.2, 0.01), (0.0, 0.003), (0.1, 0.1)])
def test_every_settled_instant_is_in_one_block(burn_in, dt):
    times = dt * np.arange(round(2.0 / dt) + 1)
    members = np.array([b.members(times) for b in blocks(times, burn_in)])
    assert len(members) == COUNT
    np.testing.assert_array_equal(members.sum(axis=0), (times > burn_in + 1e-9) & (times > 0))
    sizes = members.sum(axis=1)
    assert np.ptp(sizes) <= 1


def test_runs_of_few_instants_leave_blocks_empty():
    times = np.array([0.0, 0.1, 0.2, 0.3])
    members = np.array([b.members(times) for b in blocks(times)])
    np.testing.assert_array_equal(members.sum(axis=0), [0, 1, 1, 1])
    found = means(np.arange(8.0).reshape(4, 2), np.ones((4, 2), bool), list(members)).value
    assert found.shape == (2, COUNT)
    assert np.isnan(found).sum() == 2 * (COUNT - 3)
    assert sorted(found[1][np.isfinite(found[1])]) == [3.0, 5.0, 7.0]


def test_means_by_hand():
    values = np.array([[[1.0, 9.0]], [[3.0, np.nan]], [[5.0, 7.0]], [[np.nan, 1.0]]])
    counted = np.isfinite(values)
    counted[2, 0, 0] = False
    first, second = np.array([[True, True, False, False], [False, False, True, True]])
    found = means(values, counted, [first, second, first & second]).value
    np.testing.assert_array_equal(found, [[[2.0, 9.0], [np.nan, 4.0], [np.nan, np.nan]]])


def test_a_span_has_the_decimals_that_it_needs_and_a_phase_its_name():
    assert span([Block(0.0, 0.4)]) == "from 0.0 to 0.4 s"
    assert span([Block(0.02, 0.04)]) == "from 0.02 to 0.04 s"
    assert span([Block(1 / 3, 2 / 3)]) == "from 0.33 to 0.67 s"
    assert span([Block(0.5, 1.0), Block(1.0, 2.5)]) == "from 0.5 to 2.5 s"
    assert span([Block(10.0, 25.0)]) == "from 10.0 to 25.0 s"
    assert span([Block(0.5, 1.0, "contact")]) == "in contact"
