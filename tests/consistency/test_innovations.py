"""The verdict of innovations without truth."""

import numpy as np
import pytest

from estbench.consistency.innovations import InnovationSeries, judge_innovations
from estbench.consistency.verdict import Verdict


def judged(z, **keys):
    """The verdict of the innovations z of one channel with two components, S = 1."""
    nis = (z**2).sum(axis=1)
    dof = np.full(len(z), 2)
    series = InnovationSeries(nis, dof, nis[:, None] / 2, z)
    return judge_innovations(series, ["imu"], ["imu.x", "imu.y"], **keys)


@pytest.fixture(scope="module")
def white():
    return np.random.default_rng(3).standard_normal((20_000, 2))


def test_white_innovations_are_consistent(white):
    """20,000 updates: NIS/m has a standard deviation of 0.007, a tenth of the tolerance."""
    found = judged(white)
    assert found.verdict is Verdict.CONSISTENT
    assert found.blocks == 20
    assert abs(found.lag_one) < 0.05
    assert found.nis.low < (white**2).mean() < found.nis.high


@pytest.mark.parametrize(
    ("change", "word", "reason"),
    [
        (lambda z: 1.3 * z, Verdict.OVERCONFIDENT, "NIS/m"),
        (lambda z: 0.7 * z, Verdict.CONSERVATIVE, "NIS/m"),
        (
            lambda z: (z + np.array([0.0, 0.5])) / np.sqrt(1.125),
            Verdict.BIASED,
            "mean innovation of imu.y",
        ),
        (lambda z: (z[1:] + z[:-1]) / np.sqrt(2), Verdict.CORRELATED, "correlation"),
    ],
)
def test_what_is_wrong_is_named(white, change, word, reason):
    found = judged(change(white))
    assert found.verdict is word
    assert reason in found.reason


def test_failure_and_too_few(white):
    assert judged(white, failed=True).verdict is Verdict.DIVERGING
    assert judged(white[:15]).verdict is Verdict.UNDECIDED


def test_intervals_widen_with_correlation():
    """Of an autoregression with coefficient 0.9 the variance of the mean square is 9.5-fold."""
    noise = np.random.default_rng(1).standard_normal((20_000, 2))
    z = np.empty_like(noise)
    z[0] = noise[0]
    for k in range(1, len(z)):
        z[k] = 0.9 * z[k - 1] + np.sqrt(1 - 0.81) * noise[k]
    wide, narrow = judged(z).nis, judged(noise).nis
    assert wide.high - wide.low > 2 * (narrow.high - narrow.low)
