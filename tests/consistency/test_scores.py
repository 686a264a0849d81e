import numpy as np

from estbench.consistency.scores import inexact, score

INF = np.inf


def test_score_ratio_is_the_geometric_mean_whatever_the_unit():
    rng = np.random.default_rng(3)
    a, b = rng.uniform(1, 2, (2, 6, 3))
    unit = np.array([1.0, 1e6, 1e-4])
    lost = np.zeros(6, bool)
    expected = (np.sqrt(a / b)).prod(axis=1) ** (1 / 3)
    for scale in (1.0, unit**2):
        difference = score(a * scale, lost) - score(b * scale, lost)
        np.testing.assert_allclose(np.exp(difference), expected)


def test_score_of_lost_and_perfect_runs():
    found = score(np.array([[1.0, 1.0], [np.nan, 1.0], [0.0, 1.0]]), np.array([True, False, False]))
    assert found[0] == INF
    assert np.isnan(found[1])  # counts as lost in every comparison
    assert np.isfinite(found[2])


def test_coordinates_that_one_estimator_always_knows_are_left_out():
    a, b = ({"mse": np.ones((4, 3)), "known": np.tile(k, (4, 1))} for k in ([1, 0, 0], [0.5, 0, 1]))
    assert inexact([a, b]).tolist() == [1]
    assert inexact([{"mse": np.ones((4, 2)), "known": np.ones((4, 2))}]).tolist() == [0, 1]
    assert inexact([{"mse": np.ones((4, 2))}]).tolist() == [0, 1]  # a store of an earlier version
