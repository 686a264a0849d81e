"""Replays in results folders: compare, explain, report, plot and video read them as runs."""

import numpy as np
import pytest

from estbench.analysis.compare import compare_stores
from estbench.analysis.explanations import explanations
from estbench.analysis.formats import render
from estbench.analysis.load import load
from estbench.consistency.verdict import Verdict
from estbench.errors import StoreError
from estbench.logs.export import export
from estbench.logs.replay import replay
from estbench.scenario import load as scenarios


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """A pendulum's log of 2 s, replayed with truth and without."""
    folder = tmp_path_factory.mktemp("store")
    scenario = scenarios.resolve("pendulum", ["ekf"], runs=1, duration=2.0)
    (folder / "scenario.toml").write_text(scenario.to_toml(), encoding="utf-8")
    (file,) = export(folder / "scenario.toml", folder / "logs")
    known = scenarios.load(folder / "logs" / "scenario.toml")
    assert known.log is not None
    blind = known.model_copy(update={"log": known.log.model_copy(update={"truth": None})})
    noisy = ["filter.measurement_noise_scale=0.1"]
    return {
        "known": replay(known, file, ["ekf"], out=folder / "known"),
        "blind": replay(blind, file, ["ekf"], out=folder / "blind"),
        "wrong": replay(blind, file, ["ekf"], overrides=noisy, out=folder / "wrong"),
        "held": replay(blind, file, ["ekf"], hold_out=["encoder"], out=folder / "held"),
    }


@pytest.mark.parametrize("name", ["known", "blind", "held"])
def test_a_store_has_the_statistics_of_the_replay(stored, name):
    found = stored[name]
    again = load(found.folder)
    for r in found.replayed:
        s = again.summaries[r.label]
        assert (s.verdict, s.reason, s.truth) == (r.summary.verdict, r.summary.reason,
                                                  name == "known")  # fmt: skip
        assert vars(s.anis) == vars(r.summary.anis)
        if name != "known":  # the parts of known errors are longer
            assert vars(s.anis) == vars(r.innovations.nis)
        assert np.array_equal([i.value for i in s.rmse], [i.value for i in r.summary.rmse],
                              equal_nan=True)  # fmt: skip
        assert s.log_likelihood.value == pytest.approx(r.log_likelihood)
    assert again.log is not None
    assert again.log["held_out"] == (["encoder"] if name == "held" else [])


def test_the_average_over_parts_is_that_of_the_run(stored):
    r = stored["known"]["ekf"]
    square = np.mean(r.traces.error[1:, 0] ** 2, axis=0)
    # Parts of nearly equal length.
    assert [i.value**2 for i in r.summary.rmse] == pytest.approx(square, rel=0.05)


def test_compare(stored):
    both = compare_stores([stored["blind"].folder, stored["wrong"].folder])
    (contest,) = both.contests
    assert not contest.truth
    assert contest.ranks[0].key.startswith("blind/")
    pair = next(p for p in contest.pairs if (p.a, p.b) == ("blind/ekf", "wrong/ekf"))
    assert pair.differ
    text = render(both, "text")
    assert "Ranking by log-likelihood" in text
    assert "RMSE" not in text
    for format_ in ("csv", "json"):
        assert "density_ratio" in render(both, format_)
    known = compare_stores([stored["known"].folder])
    assert "Ranking by RMSE" in render(known, "text")
    # Other readings were fused: no pairs between the two.
    assert len(compare_stores([stored["blind"].folder, stored["held"].folder]).contests) == 2


def test_explain(stored):
    (found,) = explanations(stored["wrong"].folder)
    assert found.verdict == Verdict.OVERCONFIDENT
    assert "NIS/m" in found.findings[0].text
    for name in ("known", "blind"):
        for e in explanations(stored[name].folder):
            assert e.verdict in (Verdict.CONSISTENT, Verdict.UNDECIDED)


def test_report(stored):
    html = pytest.importorskip("estbench.report.html", reason="the extra report is not installed")
    from estbench.report.sources import load as entries

    page = html.render(entries([stored["blind"].folder]), video=False)
    assert "The truth is not known" in page
    assert 'id="innovations"' in page
    for part in ('id="rmse"', 'id="coverage"', 'id="error"', "NEES/n is"):
        assert part not in page


def test_plot_and_video(stored, tmp_path):
    plots = pytest.importorskip("estbench.report.figures.plots", reason="the extra plot is absent")
    from estbench.report.figures.frame import Paper
    from estbench.report.rendering import replay as shown
    from estbench.report.sources import load as entries

    blind = entries([stored["blind"].folder])
    for what in ("nis", "innovation"):
        plots.plot(Paper(blind), what, tmp_path / f"{what}.png")
        assert (tmp_path / f"{what}.png").stat().st_size > 1000
    with pytest.raises(StoreError, match="needs the truth"):
        plots.plot(Paper(blind), "nees", tmp_path / "nees.png")
    alone, beside = (shown.replay(stored[name].folder, 0, "ekf") for name in ("blind", "known"))
    assert np.isnan(alone.truth).all()
    assert alone.what == "NIS/m"
    assert np.isfinite(alone.nees[1:]).all()
    assert np.isfinite(beside.truth).all()
    assert len(alone.times) == len(stored["blind"].log.instants) + 1


def test_a_folder_that_exists_is_refused(stored):
    found = stored["blind"]
    with pytest.raises(StoreError, match="exists; choose another --out"):
        replay(found.prepared.scenario, "none.csv", out=found.folder)
