"""A statistic is declared once: what is declared is what every table, file and page shows."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

import estbench
from estbench.analysis import board, formats, leaderboard
from estbench.analysis.compare import compare_stores
from estbench.consistency import records, statistics, summary
from estbench.consistency.declaration import Statistic
from estbench.consistency.fields import RUN, Recorded
from estbench.consistency.intervals import Interval, mean_interval
from estbench.consistency.statistics import COORDINATE, STATISTICS, Summary

PAGE = Path(__file__).parents[2] / "docs" / "statistics.md"
LARGEST = Statistic(
    name="largest_nees", heading="max NEES/n", key="largest_nees_over_n",
    meaning="mean over runs of their largest NEES/n",
    of=lambda s: mean_interval(s.converged("largest_nees"), s.level),
    variables={
        "largest_nees": Recorded(
            RUN, "f8", "largest NEES/n", lambda b: b.traces.nees[b.settled].max(axis=0) / b.n
        )
    },
)  # fmt: skip
MEAN_SIZE = Statistic(
    name="mean_size", heading="mean size", key="mean_size",
    meaning="mean over time and runs of the error's size",
    of=lambda s: tuple(mean_interval(c, s.level) for c in s.converged("mean_size").T),
    per="coordinate", unit="[c]", note="mean size: 0 without error",
    places={"run": "full", "compare": "full", "report": "full"},
    variables={
        "mean_size": Recorded(
            COORDINATE, "f8", "time average of the size",
            lambda b: b.average(np.abs(b.traces.error)),
        )
    },
)  # fmt: skip


def test_a_summary_has_one_attribute_for_each_statistic():
    own = {"label", "runs", "judgement", "reason", "failures", "late", "gated", "known", "rank",
           "truth"}  # fmt: skip
    assert {f.name for f in dataclasses.fields(Summary)} - own == {s.name for s in STATISTICS}


def test_names_and_keys_are_unique():
    for names in ([s.name for s in STATISTICS], [s.json_key for s in STATISTICS]):
        assert len(set(names)) == len(names)


def test_every_variable_is_recorded():
    for s in STATISTICS:
        for name, variable in s.variables.items():
            assert records.SUMMARY[name] is variable


@pytest.mark.parametrize("s", STATISTICS, ids=lambda s: s.name)
def test_every_statistic_is_in_the_documentation(s):
    key = s.json_key.replace(".", "` `")
    unit = {"1": "1", "[c]": "[c]", "us/step": "µs"}[s.unit]
    variables = "; ".join(
        f"`{name}` ({', '.join(v.dims)}): {v.meaning}" for name, v in s.variables.items()
    )
    over = "all" if s.all_runs else "converged"
    row = f"| {s.heading} | `{key}` | {unit} | {over} | {s.meaning} | {variables or '–'} |"
    lines = PAGE.read_text(encoding="utf-8").splitlines()
    assert row in lines, f"add to docs/statistics.md:\n{row}"


def test_ideals_are_said_in_the_captions():
    assert statistics.ideals("board") == "NEES/n is 1"
    assert statistics.ideals("run") == (
        "NEES/n and NIS/m are 1, the innovations' lag-one correlation is 0"
    )


@pytest.fixture
def added(monkeypatch):
    """Two more statistics: what an edit of statistics.py alone would do."""
    found = (*STATISTICS[:5], LARGEST, *STATISTICS[5:], MEAN_SIZE)
    monkeypatch.setattr(statistics, "STATISTICS", found)
    for s in (LARGEST, MEAN_SIZE):
        for name, variable in s.variables.items():
            monkeypatch.setitem(records.SUMMARY, name, variable)
    attributes = [
        ("largest_nees", Interval, dataclasses.field(default=None)),
        ("mean_size", tuple, dataclasses.field(default=())),
    ]
    more = dataclasses.make_dataclass("More", attributes, bases=(Summary,), frozen=True, eq=False)
    monkeypatch.setattr(summary, "Summary", more)


def test_a_statistic_that_is_declared_is_shown_everywhere(added, tmp_path):
    folder = tmp_path / "x"
    results = estbench.run(
        "pendulum", ["ekf", "kf"], runs=7, duration=0.3, out=folder, batch_size=3
    )
    value = results["ekf"].largest_nees  # type: ignore[attr-defined]
    with estbench.open_results(folder) as tree:
        assert value.value == pytest.approx(tree["ekf/largest_nees"].values.mean())
        np.testing.assert_allclose(
            tree["ekf/mean_size"].values, np.abs(tree["ekf/error"].values[:, 1:]).mean(axis=1)
        )
    lines = str(results).splitlines()
    assert any("max NEES/n" in line for line in lines)
    assert sum("mean size" in line for line in lines) >= 2  # columns, and the caption
    found = results.to_dict()["estimators"]["ekf"]
    assert found["largest_nees_over_n"]["value"] == value.value
    assert set(found["mean_size"]["hinge"]) == {"unit", "value", "low", "high"}
    comparison = compare_stores([folder])
    for format_ in ("text", "markdown", "latex"):
        text = formats.render(comparison, format_)
        assert "max NEES/n" in text
        assert "mean size" in text
    entry = json.loads(formats.render(comparison, "json"))["contests"][0]["estimators"]["ekf"]
    assert entry["largest_nees_over_n"]["value"] == value.value
    assert entry["mean_size"]["hinge"]["unit"] == "rad"
    rows = formats.render(comparison, "csv").splitlines()
    assert sum(",largest_nees_over_n,,," in row for row in rows) == 2
    assert sum(",mean_size,hinge,rad," in row for row in rows) == 2
    boards = [leaderboard.play("pendulum", 4, ("ekf", "kf"), workers=1, duration=0.1)]
    assert "| max NEES/n |" in board.markdown(boards)
    header = board.to_csv(boards).splitlines()[0]
    assert ",largest_nees_over_n,largest_nees_over_n_low,largest_nees_over_n_high," in header


def test_a_statistic_that_is_declared_is_in_the_report(added, tmp_path):
    html = pytest.importorskip("estbench.report.html")
    folder = tmp_path / "x"
    estbench.run("pendulum", ["ekf"], runs=5, duration=0.2, out=folder, keep="summary")
    text = html.write_report([folder], video=False).read_text(encoding="utf-8")
    assert "<th>max NEES/n</th>" in text
    assert "<th>mean size</th>" in text
    assert "mean size: 0 without error" in text
