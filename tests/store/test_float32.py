"""A store of half the size: traces rounded to float32, every average as it was."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from xarray import testing

import estbench
from estbench.analysis import numbers
from estbench.analysis.compare import compare_stores
from estbench.consistency import credibility, records
from estbench.errors import StoreError
from estbench.report import sources
from estbench.report.figures.traces import statistics
from estbench.report.rendering import replay
from tests.stores import run, same

EPS, TINY = np.finfo(np.float32).eps, np.finfo(np.float32).smallest_subnormal
TRACES = (records.DIAGONAL | records.FULL).items()
"""Rounding to the nearest changes a number by at most eps/2 of it, or half the smallest."""
SMALL = {"runs": 20, "keep": "full"}


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """Results of the same runs, stored in double and in single precision."""
    folder = tmp_path_factory.mktemp("both")
    return [run(folder / name, dtype=name, **SMALL) for name in ("float64", "float32")]


def test_traces_are_single_averages_and_sums_double(both):
    with (
        estbench.open_results(both[0].folder) as double,
        estbench.open_results(both[1].folder) as single,
    ):
        assert (double.attrs["dtype"], single.attrs["dtype"]) == ("float64", "float32")
        assert single["time"].dtype == np.float64
        for name, field in TRACES:
            a, b = double["ekf"][name].values, single["ekf"][name].values
            assert b.dtype == (np.float32 if field.dtype == "f8" else field.dtype), name
            np.testing.assert_allclose(b, a, rtol=EPS / 2, atol=TINY / 2, err_msg=name)
        x = single["truth/x"].values
        assert x.dtype == np.float32
        np.testing.assert_allclose(x, double["truth/x"].values, rtol=EPS / 2, atol=TINY / 2)
        for name, field in records.SUMMARY.items():
            assert single["ekf"][name].dtype == np.dtype(field.dtype), name
            testing.assert_identical(single["ekf"][name], double["ekf"][name])


def test_the_tables_are_the_same_to_the_last_bit(both):
    a, b = (r.to_dict() for r in both)
    for each in (a, b):
        del each["folder"], each["estimators"]["ekf"]["cost_us_per_run_step"]
    assert a == b


def test_compare_reads_it(both):
    """Only NCI and inclination are of the traces.

    Both are means of 10 log₁₀(eᵀP⁻¹e / eᵀΣ⁻¹e). A relative change δ of a quadratic form changes
    its decibels by 10/ln 10 δ: eps/2 of the stored NEES, and 2 n κ eps/2 at most of the form in
    the errors, each rounded by eps/2, and as much again of Σ, which is made of them; κ is the
    condition number of their correlation matrix, as the scale of a coordinate rounds nothing.
    """
    with estbench.open_results(both[0].folder) as tree:
        error = tree["ekf/error"].values[:, 1:]
    square = credibility.mean_square(error)
    size = np.sqrt(np.diagonal(square, axis1=1, axis2=2))
    condition = np.linalg.cond(square / size[:, :, None] / size[:, None, :]).max()
    bound = 10 / np.log(10) * (1 + 2 * 2 * error.shape[-1] * condition) * EPS / 2
    (a,), (b,) = (
        numbers.to_dict(compare_stores([r.folder]))["contests"][0]["estimators"].values()
        for r in both
    )
    for name, value in a.items():
        if name in ("nci_db", "inclination_db"):
            assert b[name] == pytest.approx(value, abs=bound)
            assert b[name] != value  # it did read the rounded traces
        elif "cost" not in name and name != "folder":
            assert b[name] == value, name


def test_the_report_reads_it(both):
    (a,), (b,) = (sources.load([r.folder]) for r in both)
    double, single = statistics(a), statistics(b)
    assert double is not None
    assert single is not None
    # Fourth powers, and correlations of NIS, lose a few eps; counts only at the edge of a bin.
    np.testing.assert_allclose(single.fourth, double.fourth, rtol=4 * EPS)
    np.testing.assert_allclose(single.correlation, double.correlation, atol=16 * EPS)
    steps = 20 * 30
    width = np.diff(double.nees_edges)
    np.testing.assert_allclose(single.nees * width, double.nees * width, atol=2.5 / steps)
    seen = replay.of_entry(b, 3)
    np.testing.assert_allclose(seen.estimate, replay.of_entry(a, 3).estimate, rtol=EPS)


def test_resumed_it_is_the_uninterrupted_store(both, tmp_path):
    def interrupt(done, total):
        if done >= 10:
            raise KeyboardInterrupt

    cut = run(tmp_path / "x", dtype="float32", progress=interrupt, workers=1, **SMALL)
    assert cut.interrupted
    assert len(cut.runs) < 20
    run(tmp_path / "x", resume=True, **SMALL)  # a store keeps its own type
    same(tmp_path / "x", both[1].folder)


def test_another_type_is_refused(both):
    for results, was, asked in zip(both, ("float64", "float32"), ("float32", "float64")):
        with pytest.raises(StoreError, match=f"dtype was '{was}' and is '{asked}'; choose another"):
            run(results.folder, resume=True, dtype=asked, **SMALL)


def test_what_single_precision_cannot_hold_is_infinite(tmp_path, monkeypatch):
    nees = records.DIAGONAL["nees"]
    huge = replace(nees, of=lambda batch: 1e300 * nees.of(batch))
    monkeypatch.setitem(records.DIAGONAL, "nees", huge)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        results = run(tmp_path / "x", dtype="float32", runs=4, workers=1)
    with estbench.open_results(tmp_path / "x") as tree:
        assert np.isinf(tree["ekf/nees"].values).all()
        np.testing.assert_array_equal(tree["ekf/anees"], results.records["ekf"]["anees"])
