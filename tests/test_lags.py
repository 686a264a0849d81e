import numpy as np
import pytest

from estbench.lags import LAGS, Lags


def products(whites, masks=None):
    """Sums and terms of one group's innovations `(step, run, m)`, with loops."""
    steps, runs, m = whites.shape
    masks = np.ones((steps, runs, m), bool) if masks is None else masks
    sums, terms = np.zeros((runs, LAGS + 1)), np.zeros((runs, LAGS + 1), int)
    for lag in range(LAGS + 1):
        for k in range(lag, steps):
            both = masks[k] & masks[k - lag]
            sums[:, lag] += (whites[k] * whites[k - lag] * both).sum(axis=-1)
            terms[:, lag] += both.sum(axis=-1)
    return sums, terms


@pytest.mark.parametrize("steps", [1, 2, LAGS, 3 * LAGS])
@pytest.mark.parametrize("m", [1, 3])
def test_sums_are_those_of_a_loop(steps, m):
    whites = np.random.default_rng(steps).standard_normal((steps, 4, m))
    lags = Lags(4)
    for k, white in enumerate(whites):
        lags.put(k, 0, ("gyro",), white)
        if k % 3 == 0:
            lags.settle(k)
    for got, expected in zip(lags.finish(), products(whites)):
        np.testing.assert_allclose(got, expected, atol=1e-12)


def test_what_did_not_arrive_counts_in_neither():
    rng = np.random.default_rng(0)
    masks = rng.uniform(size=(30, 4, 2)) < 0.7
    whites = np.where(masks, rng.standard_normal((30, 4, 2)), 0.0)
    lags = Lags(4)
    for k in range(30):
        everything = k % 4 == 0  # sometimes all arrive, and no mask is given
        masks[k] |= everything
        lags.put(k, 0, ("gyro",), whites[k], None if everything else masks[k])
    for got, expected in zip(lags.finish(), products(whites, masks)):
        np.testing.assert_allclose(got, expected, atol=1e-12)


def test_other_channels_have_their_own_past():
    whites = np.random.default_rng(1).standard_normal((20, 3, 2))
    lags, groups = Lags(3), {("gyro",): [], ("gyro", "position"): []}
    for k, white in enumerate(whites):
        channels = ("gyro", "position") if k % 4 == 0 else ("gyro",)
        white = white if k % 4 == 0 else white[:, :1]
        groups[channels].append(white)
        lags.put(k, 0, channels, white)
    expected = [products(np.array(g)) for g in groups.values()]
    sums, terms = lags.finish()
    np.testing.assert_allclose(sums, expected[0][0] + expected[1][0], atol=1e-12)
    np.testing.assert_array_equal(terms, expected[0][1] + expected[1][1])


def test_a_replay_replaces_what_is_not_settled():
    whites = np.random.default_rng(2).standard_normal((8, 2, 1))
    lags = Lags(2)
    for k in range(8):
        lags.put(k, 0, ("gyro",), np.full((2, 1), 99.0) if k > 3 else whites[k])
        lags.settle(min(k, 4))
    for k in range(4, 8):
        lags.put(k, 0, ("gyro",), whites[k])
    np.testing.assert_allclose(lags.finish()[0], products(whites)[0])


def test_a_failed_run_spoils_only_itself():
    whites = np.random.default_rng(3).standard_normal((9, 3, 2))
    whites[5:, 1] = np.nan
    lags = Lags(3)
    for k, white in enumerate(whites):
        lags.put(k, 0, ("gyro",), white)
    sums, _ = lags.finish()
    assert np.isnan(sums[1, 0])
    np.testing.assert_allclose(sums[[0, 2]], products(whites[:, [0, 2]])[0])


def test_no_components_and_no_innovations():
    lags = Lags(2)
    assert not np.any(lags.finish()[1])
    lags.put(0, 0, ("none",), np.empty((2, 0)))
    lags.put(1, 0, ("none",), np.empty((2, 0)))
    assert not np.any(lags.finish()[1])
