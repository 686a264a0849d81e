"""Stores of earlier versions, which have fewer variables."""

import shutil

import numpy as np
import pytest

from estbench.analysis.compare import compare_stores
from estbench.analysis.explanations import explanations
from estbench.analysis.formats import render
from estbench.analysis.load import REQUIRED, load
from estbench.consistency.records import SUMMARY
from estbench.errors import AnalysisError, StoreError
from tests import stores


@pytest.fixture(scope="module")
def earlier(tmp_path_factory):
    """A store with what that of the first versions had, and the same store whole."""
    folder = tmp_path_factory.mktemp("stores")
    stores.run(folder / "now", runs=12, keep="summary")
    shutil.copytree(folder / "now", folder / "earlier")
    sums = {"count", "dof_sum", "nees_sum", "nis_sum", "square_sum", "variance_sum"}
    kept = REQUIRED | sums | {"lag_one", "inside_1", "inside_2", "inside_3", "late"}
    for name in SUMMARY.keys() - kept:
        shutil.rmtree(folder / "earlier" / "data.zarr" / "ekf" / name)
    shutil.rmtree(folder / "earlier" / "data.zarr" / "channel")
    stores.unsealed(folder / "earlier")
    return folder


def test_it_opens_and_what_it_lacks_is_unknown(earlier):
    old, new = load(earlier / "earlier"), load(earlier / "now")
    a, b = old.summaries["ekf"], new.summaries["ekf"]
    assert a.anees == b.anees
    assert a.rmse == b.rmse
    assert np.isnan(a.log_likelihood.value)
    assert np.isnan([i.value for i in (*a.mean_error, *a.skew)]).all()
    assert len(a.mean_error) == len(b.mean_error) == 2
    lacking = "not tested, as the store is of an earlier version: NEES/n in a block of time"
    assert lacking in a.reason
    assert "not tested" not in b.reason
    for format_ in ("text", "json", "csv"):
        shown = render(compare_stores([earlier / "earlier"]), format_)
        assert lacking in " ".join(shown.split()) or format_ == "csv"
    with pytest.raises(AnalysisError, match=r"lacks nees_by_block, .* of an earlier version"):
        explanations(earlier / "earlier")


def test_it_is_not_continued(earlier):
    with pytest.raises(StoreError, match=r"begun with an earlier version .* no ekf/.*--out"):
        stores.run(earlier / "earlier", runs=12, keep="summary", resume=True)
