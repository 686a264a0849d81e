"""Whiteness in the report: of all innovations, and of each channel where a store keeps them."""

from dataclasses import replace

import numpy as np
import pytest

from estbench.consistency.whiteness import whiteness
from estbench.inference.lags import Lags
from estbench.report import sources
from estbench.report.figures import innovations


@pytest.fixture
def entry(entries):
    return entries("two")[0]


def with_white(entry, white):
    """The entry with innovations `(run, step, m)` of a test."""
    lags = Lags(len(white), {"a": white.shape[-1]})
    for k in range(white.shape[1]):
        lags.put(k, 0, ["a"], white[:, k])
    sums, terms = lags.sums()
    return replace(entry, record={**entry.record, "lags": sums, "lag_terms": terms})


def test_white_innovations_are_in_their_band(entry):
    white = np.random.default_rng(0).standard_normal((len(entry.good), 200, 2))
    found = innovations.whole(with_white(entry, white))
    assert found is not None
    values = np.array([i.value for i in found.found.correlation])
    # 10 lags, each outside with 5%: more than 3 with 0.1%.
    assert (np.abs(values) > found.band).sum() <= 3
    # The band of one lag is that of all its products together.
    assert found.band[0] == pytest.approx(1.96 / np.sqrt(12 * 199 * 2), rel=1e-3)


def test_correlated_innovations_are_not(entry):
    noise = np.random.default_rng(1).standard_normal((len(entry.good), 201, 1))
    found = innovations.whole(with_white(entry, noise[:, 1:] + 0.5 * noise[:, :-1]))
    assert found is not None
    assert found.found.correlation[0].value == pytest.approx(0.4, abs=0.05)  # 0.5/(1 + 0.5²)
    assert found.found.correlation[0].value > 5 * found.band[0]
    assert found.found.rejected.value > 0.9


def test_a_store_keeps_them(entries):
    for entry in entries("two"):
        found = innovations.whole(entry)
        assert found is not None
        good = entry.good
        record = entry.record
        assert found.found == whiteness(record["lags"][good], record["lag_terms"][good], 0.95)
        assert found.found.correlation[0] == entry.summary.lag_one


def test_each_channel_of_a_full_store(entries, store):
    (entry,) = entries("full")
    found = innovations.by_channel(entry)
    assert list(found) == list(
        dict.fromkeys(str(n).partition(".")[0] for n in sources.read(entry.source.tree, "reading"))
    )
    # The sums of one channel by hand: each instant's innovation whitened by its own block of S.
    residual, cov = (entry.group[k].values for k in ("innovation", "innovation_cov"))
    channel, width = next(iter(found)), 3
    where = np.isfinite(residual[..., :width]).all(axis=-1)
    rows = []
    for run, came in enumerate(where):
        white = np.array(
            [
                np.linalg.solve(
                    np.linalg.cholesky(cov[run, k, :width, :width]), residual[run, k, :width]
                )
                for k in np.flatnonzero(came)
            ]
        )
        n = len(white)
        rows.append(
            (white[1:] * white[:-1]).sum() / (width * (n - 1)) / ((white**2).sum() / (width * n))
        )
    assert found[channel].found.correlation[0].value == pytest.approx(np.mean(rows))


def test_nothing_without_lag_products(entry):
    bare = {k: v for k, v in entry.record.items() if k not in ("lags", "lag_terms")}
    assert innovations.whole(replace(entry, record=bare)) is None
