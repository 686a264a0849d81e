import numpy as np
import pytest

from estbench.inference.lags import LAGS, Lags, correlation

WIDTHS = {"gyro": 2, "position": 1}


def by_hand(arrivals, runs):
    """Sums and terms: each run's and component's arrivals in order, multiplied with loops.

    Args:
        arrivals: (channels, white, mask) one after the other.
        runs: how many.
    """
    sums, terms = np.zeros((runs, LAGS + 1)), np.zeros((runs, LAGS + 1), int)
    for run in range(runs):
        series = {(name, i): [] for name, width in WIDTHS.items() for i in range(width)}
        for channels, white, mask in arrivals:
            places = [(name, i) for name in channels for i in range(WIDTHS[name])]
            for j, place in enumerate(places):
                if mask is None or mask[run, j]:
                    series[place].append(white[run, j])
        for y in series.values():
            for lag in range(LAGS + 1):
                sums[run, lag] += sum(y[k] * y[k - lag] for k in range(lag, len(y)))
                terms[run, lag] += max(0, len(y) - lag)
    return sums, terms


def fed(arrivals, runs):
    lags = Lags(runs, WIDTHS)
    for k, (channels, white, mask) in enumerate(arrivals):
        lags.put(k, 0, channels, white, mask)
    return lags.sums()


def check(arrivals, runs):
    for got, expected in zip(fed(arrivals, runs), by_hand(arrivals, runs)):
        np.testing.assert_allclose(got, expected, atol=1e-12)


def normal(seed, steps, runs=4, m=2):
    return np.random.default_rng(seed).standard_normal((steps, runs, m))


@pytest.mark.parametrize("steps", [1, 2, LAGS, 3 * LAGS])
def test_sums_are_those_of_a_loop(steps):
    check([(("gyro",), white, None) for white in normal(steps, steps)], 4)


def test_what_did_not_arrive_is_neither_counted_nor_waited_for():
    masks = np.random.default_rng(0).uniform(size=(30, 4, 2)) < 0.7
    whites = np.where(masks, normal(1, 30), 0.0)
    check([(("gyro",), white, mask) for white, mask in zip(whites, masks)], 4)


def test_a_component_that_seldom_arrives_has_no_terms_of_longer_lags():
    masks = np.ones((6, 4, 2), bool)
    masks[1:, 0, 1], masks[3:, 1, 0], masks[:, 2, 1] = False, False, False
    whites = np.where(masks, normal(9, 6), 0.0)
    check([(("gyro",), white, mask) for white, mask in zip(whites, masks)], 4)


def test_a_mask_now_and_then():
    masks = np.random.default_rng(2).uniform(size=(30, 4, 2)) < 0.7
    check(
        [
            (("gyro",), white, mask if k % 3 else None)
            for k, (white, mask) in enumerate(zip(normal(3, 30), masks))
        ],
        4,
    )


def test_components_have_their_own_past_whatever_comes_with_them():
    arrivals = []
    for k, white in enumerate(normal(4, 40, m=3)):
        channels = [("gyro",), ("gyro", "position"), ("position",), ("gyro",)][k % 4]
        m = sum(WIDTHS[name] for name in channels)
        arrivals.append((channels, white[:, :m], None))
    check(arrivals, 4)


def test_runs_do_not_depend_on_their_batch():
    masks = np.random.default_rng(5).uniform(size=(30, 6, 2)) < 0.7
    arrivals = [(("gyro",), w, m) for w, m in zip(normal(6, 30, runs=6), masks)]
    whole = fed(arrivals, 6)
    part = fed([(c, w[2:4], m[2:4]) for c, w, m in arrivals], 2)
    for got, expected in zip(part, whole):
        np.testing.assert_array_equal(got, expected[2:4])


def test_a_replay_replaces():
    whites = normal(7, 8)
    lags = Lags(4, WIDTHS)
    for k in range(8):
        lags.put(k, 0, ("gyro",), np.full((4, 2), 99.0) if k > 3 else whites[k])
    for k in range(4, 8):
        lags.put(k, 0, ("gyro",), whites[k])
    expected = by_hand([(("gyro",), white, None) for white in whites], 4)
    np.testing.assert_allclose(lags.sums()[0], expected[0])


def test_a_failed_run_spoils_only_itself():
    whites = normal(8, 9)
    whites[5:, 1] = np.nan
    sums, terms = fed([(("gyro",), white, None) for white in whites], 4)
    assert np.isnan(sums[1, 0])
    keep = [0, 2, 3]
    expected = by_hand([(("gyro",), white[keep], None) for white in whites], 3)
    np.testing.assert_allclose(sums[keep], expected[0])
    np.testing.assert_array_equal(terms[keep], expected[1])


def test_nothing_arrived():
    sums, terms = Lags(2, WIDTHS).sums()
    assert sums.shape == terms.shape == (2, LAGS + 1)
    assert not terms.any()


@pytest.mark.parametrize("scale", [1.0, 7.0])
def test_a_correlation_is_that_of_numpy_whatever_the_size(scale):
    """Of one long component of mean zero, where the ends do not matter."""
    noise = np.random.default_rng(9).standard_normal((4001, 3, 1))
    x = noise[1:] + 0.5 * noise[:-1]  # 0.5/(1 + 0.5²) = 0.4 at lag 1
    lags = Lags(3, {"position": 1})
    for k, white in enumerate(scale * x):
        lags.put(k, 0, ("position",), white)
    rho = correlation(*lags.sums())
    assert (rho[:, 0] == 1).all()
    for run in range(3):
        expected = np.corrcoef(x[1:, run, 0], x[:-1, run, 0])[0, 1]
        assert rho[run, 1] == pytest.approx(expected, abs=2e-3)
    np.testing.assert_allclose(rho[:, 1], 0.4, atol=0.0625)  # sigma 0.0125: 5 sigma, 2e-6


def test_a_lag_without_terms_has_no_correlation():
    rho = correlation(*fed([(("gyro",), white, None) for white in normal(10, 2)], 4))
    assert np.isfinite(rho[:, :2]).all()
    assert np.isnan(rho[:, 2:]).all()


def test_nis_of_channels_by_hand_and_a_replay_replaces():
    lags = Lags(2, WIDTHS)
    lags.put(1, 0, ("gyro", "position"), np.array([[1.0, 2.0, 3.0], [1.0, 0.0, 4.0]]),
             np.array([[True, True, True], [True, False, True]]))  # fmt: skip
    lags.put(1, 1, ("gyro",), np.array([[3.0, 4.0], [0.0, 0.0]]),
             np.array([[True, True], [False, False]]))  # fmt: skip
    lags.put(2, 0, ("position",), np.array([[9.0], [9.0]]))
    lags.put(2, 0, ("position",), np.array([[5.0]]), None, np.array([0]))
    found, nan = lags.nis(4), np.nan
    np.testing.assert_array_equal(found[..., 0], [[nan, nan], [30 / 4, 1.0], [nan] * 2, [nan] * 2])
    np.testing.assert_array_equal(found[..., 1], [[nan, nan], [9.0, 16.0], [25.0, 81.0], [nan] * 2])
