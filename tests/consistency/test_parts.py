"""One run in parts of time."""

from types import SimpleNamespace

import numpy as np
import pytest

from estbench.consistency.parts import LONG, most_parts


def traces(error):
    return SimpleNamespace(error=error[:, None, None], sigma=np.ones((len(error), 1, 1)))


def test_parts_are_long_against_the_correlation_of_the_errors():
    """Of an autoregression with coefficient a it is (1 + a)/(1 - a) instants: 19 for 0.9.

    Over 20,000 instants the estimate is within a factor of 1.5 for any seed tried.
    """
    noise = np.random.default_rng(0).standard_normal(20_000)
    z = np.empty_like(noise)
    z[0] = noise[0]
    for k in range(1, len(z)):
        z[k] = 0.99 * z[k - 1] + noise[k]
    settled = np.ones(len(z), bool)
    expected = 20_000 / LONG / 199
    assert expected / 1.5 < most_parts(traces(z), settled) < expected * 1.5
    assert most_parts(traces(noise), settled) == 20
    assert most_parts(traces(z + 50), settled) == most_parts(traces(z), settled)
    assert most_parts(traces(np.full(50, np.nan)), np.ones(50, bool)) == 20


def test_a_short_run_is_one_part():
    assert most_parts(traces(np.sin(np.linspace(0, 3, 40))), np.ones(40, bool)) == pytest.approx(1)
