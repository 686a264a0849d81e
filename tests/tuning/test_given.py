import numpy as np

from estbench.estimators.kf import KF
from tests.tuning import linear


def test_the_likelihood_is_that_of_the_joint_distribution():
    y = linear.readings()
    found = linear.given(y)([(0.3, 0.5), (3.0, 0.1)])
    for values, total in zip([(0.3, 0.5), (3.0, 0.1)], found.log_likelihood):
        np.testing.assert_allclose(total, -linear.dense(y, values), rtol=1e-10)
    assert found.mse is None
    assert found.reasons == ("", "")


def test_missing_measurements_are_left_out():
    y = linear.readings()
    y[10:15, 3] = np.nan
    (found,) = linear.given(y)([(0.3, 0.5)]).log_likelihood
    keep = np.r_[0:10, 15 : linear.STEPS]
    k = np.arange(1, linear.STEPS + 1)
    S = (1.0 + 0.3 * np.minimum.outer(k, k) + 0.5 * np.eye(len(k)))[np.ix_(keep, keep)]
    z = y[keep, 3, 0]
    expected = -0.5 * (z @ np.linalg.solve(S, z) + np.linalg.slogdet(2 * np.pi * S)[1])
    np.testing.assert_allclose(found[3], expected, rtol=1e-10)
    whole = [i for i in range(linear.RUNS) if i != 3]
    np.testing.assert_allclose(found[whole], -linear.dense(y, (0.3, 0.5))[whole], rtol=1e-10)


def test_a_candidate_that_is_refused_has_a_reason():
    y = linear.readings()
    found = linear.given(y)([(0.3, -1.0), (0.3, 0.5)])
    assert np.isnan(found.log_likelihood[0]).all()
    assert "R is not symmetric positive definite" in found.reasons[0]
    assert found.reasons[1] == ""
    assert isinstance(KF(linear.model((0.3, 0.5))), KF)
