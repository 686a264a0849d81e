import pytest

pytest.importorskip("matplotlib")

import matplotlib.image
import numpy as np

from estbench.errors import EstbenchError, StoreError
from estbench.report import sources
from estbench.report.figures import data, innovations, paper, plots


@pytest.mark.parametrize("what", [what for what in plots.KINDS if what != "touch-down"])
@pytest.mark.parametrize("columns", [1, 2])
def test_every_kind_is_drawn_as_wide_as_it_should_be(entries, tmp_path, what, columns):
    path = tmp_path / "a.png"
    kept = "full" if what == "innovation" else "two"
    plots.plot(plots.Paper(entries(kept), columns), what, path)
    picture = matplotlib.image.imread(path)
    assert picture.shape[1] == round(paper.WIDTHS[columns] * 200)
    assert (picture[..., :3].min(axis=2) < 0.8).mean() > 0.01  # there is ink


def test_innovations_that_were_not_kept(entries, tmp_path):
    with pytest.raises(StoreError, match="kept none; run with --keep full"):
        plots.plot(plots.Paper(entries("two"), 1), "innovation", tmp_path / "a.png")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", paper.FORMATS)
def test_the_same_file_twice(entries, tmp_path, kind):
    for name in "ab":
        plots.plot(plots.Paper(entries("two")), "nees", tmp_path / f"{name}.{kind}")
    first, second = ((tmp_path / f"{name}.{kind}").read_bytes() for name in "ab")
    assert first == second


def test_the_curve_is_the_mean_and_the_band_that_of_consistency(entries):
    pair = entries("two")
    ax = plots._nees(plots.Paper(pair)).axes[0]
    steps = data.nees_steps(pair[0])
    np.testing.assert_array_equal(ax.lines[0].get_ydata(), steps.mean)
    corners = np.asarray(ax.collections[0].get_paths()[0].vertices)
    assert corners[:, 1].min() == steps.low.min()
    assert corners[:, 1].max() == steps.high.max()


def test_chosen_coordinates_and_run(entries):
    pair = entries("two")
    name = pair[0].source.names[1]
    figure = plots._error(plots.Paper(pair, 1, run=5, coordinates=[name]))
    (ax,) = figure.axes
    assert ax.get_ylabel() == "hinge.vel (rad/s)"
    error = pair[0].group["error"].values[5, :, 1]
    np.testing.assert_array_equal(ax.lines[0].get_ydata(), error)


def test_a_summary_has_coverage_and_the_correlation_of_its_innovations(entries, tmp_path):
    bare = plots.Paper(entries("bare"))
    ax = plots._autocorrelation(bare).axes[0]
    white = innovations.whole(bare.entries[0])
    assert white is not None
    np.testing.assert_array_equal(
        ax.lines[0].get_ydata(), [i.value for i in white.found.correlation]
    )
    assert ax.get_ylabel() == "autocorrelation, innovations"
    assert plots._autocorrelation(plots.Paper(entries("two"))).axes[0].get_ylabel().endswith("NIS")
    for what in ("coverage", "autocorrelation"):
        plots.plot(bare, what, tmp_path / f"{what}.png")
    for name in ("lags", "inside_2"):
        del bare.entries[0].record[name]
    for what in ("coverage", "autocorrelation"):
        with pytest.raises(StoreError, match=f"has no {what} of ekf: it is of an older version"):
            plots.plot(bare, what, tmp_path / "a.png")


def test_bad_input(entries, store, tmp_path):
    paper = plots.Paper(entries("two"))
    with pytest.raises(EstbenchError, match="did you mean 'nees'"):
        plots.plot(paper, "nes", tmp_path / "a.png")
    with pytest.raises(EstbenchError, match="use png, pdf, svg"):
        plots.plot(paper, "nees", tmp_path / "a.jpg")
    with pytest.raises(StoreError, match="cannot be written"):
        plots.plot(paper, "nees", tmp_path / "no" / "a.png")
    with pytest.raises(StoreError, match="needs traces"):
        plots.plot(plots.Paper(sources.load([store("bare")])), "error", tmp_path / "a.png")
    with pytest.raises(EstbenchError, match="no run of ekf has an event 'touch-down'; use runs"):
        plots.plot(paper, "touch-down", tmp_path / "a.png")
    with pytest.raises(StoreError, match="no finished run 99; it has 12 runs, 0 to 11"):
        plots.plot(plots.Paper(entries("two"), run=99), "error", tmp_path / "a.png")
    with pytest.raises(EstbenchError, match="did you mean 'hinge'"):
        plots.plot(plots.Paper(entries("two"), coordinates=["hing"]), "rmse", tmp_path / "a.png")
