import numpy as np
import pytest

from estbench.errors import EstbenchError
from estbench.scenario.load import resolve
from estbench.study import run as running
from estbench.study import sweep

pytest.importorskip("matplotlib")
from matplotlib.collections import LineCollection

from estbench.report.figures import sweeps


def swept(over, **options):
    scenario = resolve("pendulum", ["ekf", "ukf"], runs=8, duration=0.3)
    study = sweep.design(scenario, over, **options)
    return study, running.run(study).dataset()


@pytest.fixture(scope="module")
def three():
    return swept(["filter.process_noise_scale=log:0.01:100:3", "start.inflate=1,2",
                  "filter.delays=exact,naive"])  # fmt: skip


def part(study, found, count):
    """The sweep over the first keys alone."""
    keys = [axis.key for axis in study.axes]
    return type(study)(study.scenario, study.axes[:count]), found.isel(
        dict.fromkeys(keys[count:], 0)
    )


def test_one_key_has_a_line_per_estimator_with_intervals(three, tmp_path):
    study, found = part(*three, 1)
    figure = sweeps._lines(study, found, sweeps.DEFAULT)
    top, bottom = figure.axes
    assert [t.get_text() for t in top.get_legend().get_texts()] == ["ekf", "ukf"]
    assert top.get_xscale() == bottom.get_xscale() == "log"
    line, _, (bars,) = top.containers[0]
    expected = found.anees_over_n.sel(estimator="ekf").values
    np.testing.assert_allclose(line.get_ydata(), expected)
    ends = np.array([segment[:, 1] for segment in bars.get_segments()])
    np.testing.assert_allclose(ends[:, 0], found.anees_over_n_low.sel(estimator="ekf").values)
    np.testing.assert_allclose(ends[:, 1], found.anees_over_n_high.sel(estimator="ekf").values)
    sweeps.draw(study, found, tmp_path / "a.svg")
    assert (tmp_path / "a.svg").read_text().count("<path") > 10


def test_two_keys_have_a_map_with_the_consistent_region_outlined(three):
    study, found = part(*three, 2)
    found = found.copy(deep=True)
    good = np.array([[True, True], [False, True], [False, False]])
    found["verdict"].values[..., 0] = np.where(good, "consistent", "overconfident")
    figure = sweeps._maps(study, found, ["anees_over_n"])
    mesh = figure.axes[0].collections[0]
    np.testing.assert_allclose(mesh.get_array().reshape(2, 3), found.anees_over_n.values[..., 0].T)
    (lines, _) = (c for c in figure.axes[0].collections if isinstance(c, LineCollection))
    assert len(lines.get_segments()) == 8  # around three cells in an L
    assert [t.get_text() for t in figure.axes[0].get_xticklabels()] == ["0.01", "1", "100"]
    assert figure.get_supxlabel() == "outlined: the verdict is consistent"


def test_the_cells_of_a_map_are_in_ascending_order_and_no_region_is_claimed():
    study, found = swept(["filter.process_noise_scale=10,0.1,1", "start.inflate=2,1"])
    found = found.copy(deep=True)
    found["verdict"].values[...] = "undecided"
    figure = sweeps._maps(study, found, ["anees_over_n"])
    mesh = figure.axes[0].collections[0]
    expected = found.anees_over_n.values[[1, 2, 0]][:, [1, 0], 0]
    np.testing.assert_allclose(mesh.get_array().reshape(2, 3), expected.T)
    assert [t.get_text() for t in figure.axes[0].get_yticklabels()] == ["1", "2"]
    assert figure.get_supxlabel() == "no verdict is consistent"


def test_three_keys_have_small_multiples(three, tmp_path):
    figure = sweeps._multiples(*three, ["anees_over_n"])
    titles = [a.get_title() for a in figure.axes if a.get_title()]
    assert titles[:2] == ["ekf, filter.delays = exact", "ekf, filter.delays = naive"]
    assert len(titles) == 4


def test_the_points_of_a_design_are_drawn_as_points():
    over = {"filter.process_noise_scale": "log:0.1:10", "start.inflate": "log:0.5:2"}
    study, found = swept(over, sample="sobol", points=8)
    figure = sweeps._maps(study, found, ["rmse"])
    points = figure.axes[0].collections[-1].get_offsets()
    np.testing.assert_allclose(points[:, 0], found["filter.process_noise_scale"])
    with pytest.raises(EstbenchError, match="at most three keys of a grid, or two of a design"):
        sweeps.draw(type(study)(study.scenario, study.axes * 2, grid=False), found, None, ["rmse"])


def test_an_unknown_statistic(three, tmp_path):
    with pytest.raises(EstbenchError, match="known: anees_over_n, anees_over_n_median"):
        sweeps.draw(*three, tmp_path / "a.png", ["anees"])
