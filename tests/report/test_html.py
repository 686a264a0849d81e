"""The page is parsed, and its numbers compared with the store's statistics."""

import base64
import html
import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

pytest.importorskip("plotly")
pytest.importorskip("jinja2")

from estbench.analysis.explanations import of
from estbench.consistency.coverage import SIGMAS
from estbench.consistency.intervals import positive_mean_interval
from estbench.consistency.nees import chi_square_band
from estbench.consistency.records import SUMMARY
from estbench.consistency.summary import summarize
from estbench.consistency.verdict import Verdict
from estbench.report import budgets, pairs, sources
from estbench.report.figures import data, innovations, traces
from estbench.report.figures.shares import drawings as shares_of
from estbench.report.html import render, write_report
from estbench.report.tables import notices


class Tables(HTMLParser):
    """`cells[table id or baseline]`: rows of (text, data-value, data-p if there is one)."""

    def __init__(self, page):
        super().__init__()
        self.cells, self._name, self._row, self._cell = {}, None, None, None
        self.ids, self.words, self.twice = set(), [], []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        if "id" in attrs and attrs["id"] in self.ids:
            self.twice.append(attrs["id"])
        self.ids.add(attrs.get("id"))
        if "data-baseline" in attrs:
            self._name = f"baseline {attrs['data-baseline']}"
            self.cells[self._name] = []
        if tag == "table" and attrs.get("id", attrs.get("class")):
            self._name = attrs.get("id", attrs.get("class"))
            self.cells.setdefault(self._name, [])
        if tag == "tr" and self._name:
            self._row = []
            self.cells[self._name].append(self._row)
        if tag in ("td", "th") and self._row is not None:
            self._cell = ["", attrs.get("data-value")]
            if "data-p" in attrs:
                self._cell.append(attrs["data-p"])
            self._row.append(self._cell)

    def handle_endtag(self, tag):
        if tag in ("td", "th"):
            self._cell = None
        if tag == "table":
            self._name = self._row = None

    def handle_data(self, text):
        if self._cell is not None:
            self._cell[0] += text
        else:
            self.words.append(text)


def page_data(page):
    text = re.search(r'id="page-data">(.*?)</script>', page, re.DOTALL)
    assert text is not None
    return json.loads(text.group(1))


def numbers(packed):
    if isinstance(packed, dict):
        kind = {"f8": "<f8", "f4": "<f4", "i1": "i1", "i2": "<i2"}[packed["dtype"]]
        values = np.frombuffer(base64.b64decode(packed["bdata"]), kind)
        return values.reshape(packed["shape"]) if "shape" in packed else values
    return np.array(packed)


def trace(page, drawing, entry, **wanted):
    found = [
        t
        for t in page["drawings"][drawing]["traces"]
        if t["meta"].get("entry") == entry and all(t["meta"].get(k) == v for k, v in wanted.items())
    ]
    assert len(found) == 1
    return found[0]


@pytest.fixture(scope="module")
def two(store_two):
    entries = sources.load([store_two])
    page = render(entries, video=False)
    return entries, Tables(page), page_data(page), page


@pytest.fixture(scope="module")
def store_two(tmp_path_factory):
    import estbench

    folder = tmp_path_factory.mktemp("html") / "two"
    estbench.run("pendulum", ["ekf", "ukf"], runs=12, duration=1.0, out=folder, batch_size=5)
    return folder


def test_table_of_verdicts(two):
    entries, tables, _, _ = two
    rows = tables.cells["table-verdicts"][1:]
    for entry, row in zip(entries, rows, strict=True):
        s = entry.summary
        assert row[0][0] == entry.key
        assert row[1][0] == str(s.verdict)
        steps = data.nees_steps(entry), data.nis_steps(entry)
        expected = [
            s.anees.value, s.anees_median, s.anis.value, s.lag_one.value,
            s.log_likelihood.value, s.diverged, s.efficiency.value, s.cost,
            steps[0].outside, steps[1].outside,
        ]  # fmt: skip
        assert [float(value) for _, value in row[2:]] == expected


def of_coordinate(s, i):
    """The statistics of one coordinate, as the table has them."""
    return [
        s.rmse[i].value, s.std[i], s.efficiency_each[i].value, s.mean_error[i].value,
        s.skew[i].value,
    ]  # fmt: skip


def test_table_of_rmse(two):
    entries, tables, _, _ = two
    source = entries[0].source
    for i, row in enumerate(tables.cells["table-rmse"][1:]):
        assert [row[0][0], row[1][0]] == [source.names[i], source.units[i]]
        expected = [v for e in entries for v in of_coordinate(e.summary, i)]
        assert [float(value) for _, value in row[2:]] == expected


def test_table_of_differences(two):
    entries, tables, _, _ = two
    for d in pairs.differences(entries):
        rows = tables.cells[f"baseline {d.baseline}"][1:]
        expected = [
            d.score.ratio.value, d.score.wilcoxon, d.score.sign, d.score.paired.less, d.cost,
            d.nees.difference.value, *(q.difference.value for q in d.rmse), d.nees.runs,
        ]  # fmt: skip
        assert [float(row[2][1]) for row in rows] == expected
        assert [float(p) for _, _, p in (row[2] for row in rows[5:-1])] == d.p.tolist()


def test_shown_numbers_are_the_full_ones_rounded(two):
    _, tables, _, _ = two
    for name in ("table-verdicts", "table-rmse"):
        for row in tables.cells[name][1:]:
            for shown, value in row[2:]:
                first = re.match(r"-?[\d.]+(e-?\d+)?", shown)
                assert first is not None
                scale = 100 if shown.endswith("%") else 1
                text = first.group(0)
                decimals = len(text.partition("e")[0].partition(".")[2])
                unit = 10.0 ** (-decimals + int(text.partition("e")[2] or 0))
                assert float(text) == pytest.approx(scale * float(value), abs=0.501 * unit + 1e-15)


def test_nees_and_nis_curves_with_their_bands(two):
    entries, _, page, _ = two
    for entry in entries:
        n, good = entry.source.n, int(entry.good.sum())
        nees = trace(page, "nees", entry.key, role="mean")
        traced = entry.group["nees"].values[entry.good].mean(axis=0) / n
        np.testing.assert_allclose(numbers(nees["y"]), traced, rtol=1e-12)
        np.testing.assert_array_equal(numbers(nees["x"]), entry.source.times)
        bounds = chi_square_band(n, good, 0.95)
        for side, bound in zip(("low", "high"), bounds):
            band = numbers(trace(page, "nees", entry.key, side=side)["y"])
            np.testing.assert_allclose(band, bound / n, rtol=1e-12)
        nis, dof = (entry.group[k].values[entry.good] for k in ("nis", "dof"))
        used = dof.any(axis=0)
        curve = trace(page, "nis", entry.key, role="mean")
        expected = np.nansum(nis[:, used], axis=0) / dof[:, used].sum(axis=0)
        np.testing.assert_allclose(numbers(curve["y"]), expected, rtol=1e-12)


def test_rmse_curves(two):
    entries, _, page, _ = two
    for entry in entries:
        for i in range(entry.source.n):
            curve = trace(page, f"rmse-{i}", entry.key, role="rmse")
            keep = np.searchsorted(entry.source.times, numbers(curve["x"]))
            square = entry.group["error"].values[entry.good, :, i] ** 2
            expected = np.sqrt(square.mean(axis=0))[keep]
            np.testing.assert_allclose(numbers(curve["y"]), expected, rtol=1e-12)
            low = numbers(trace(page, f"rmse-{i}", entry.key, side="low")["y"])
            bound = positive_mean_interval(square[:, keep[9]], 0.95).low
            assert low[9] == pytest.approx(np.sqrt(bound), rel=1e-9)


def check_coverage(page, entry):
    coverage = data.coverage(entry)
    assert coverage is not None
    for k, sigmas in enumerate(SIGMAS):
        shown = trace(page, f"coverage-{sigmas}", entry.key)
        np.testing.assert_array_equal(numbers(shown["x"]), [c.shares[k].value for c in coverage])
        high = [c.shares[k].high - c.shares[k].value for c in coverage]
        np.testing.assert_array_equal(numbers(shown["error_x"]["array"]), high)


def test_coverage_and_densities(two):
    entries, _, page, _ = two
    for entry in entries:
        found = traces.statistics(entry)
        assert found is not None
        check_coverage(page, entry)
        for i in range(entry.source.n):
            density = trace(page, f"density-{i}", entry.key, role="density")
            np.testing.assert_array_equal(numbers(density["y"]), found.errors[i])
        line = trace(page, "nis-correlation", entry.key, role="correlation")
        np.testing.assert_array_equal(numbers(line["y"]), found.correlation[1:])
        cost = trace(page, "step-cost", entry.key)
        np.testing.assert_array_equal(numbers(cost["x"]), [entry.summary.cost])


def test_shares_outside_the_band_of_one_run(two):
    entries, tables, _, _ = two
    for entry, row in zip(entries, tables.cells["table-outside"][1:], strict=True):
        found = traces.statistics(entry)
        assert found is not None
        assert [float(value) for _, value in row[1:]] == list(found.outside)


def test_whiteness(two):
    entries, tables, page, _ = two
    for entry, row in zip(entries, tables.cells["table-white"][1:], strict=True):
        found = innovations.whole(entry)
        assert found is not None
        expected = [entry.summary.lag_one.value, found.found.rejected.value, found.found.p]
        assert [float(value) for _, value in row[1:]] == expected
        line = trace(page, "innovations", entry.key, role="innovations")
        expected = [i.value for i in found.found.correlation]
        np.testing.assert_array_equal(numbers(line["y"]), expected)
        band = numbers(trace(page, "innovations", entry.key, side="high")["y"])
        np.testing.assert_array_equal(band, found.band)


def test_many_estimators_have_a_row_each(two):
    entries, _, _, _ = two
    many = [replace(e, key=f"{e.key}{i}") for i in range(2) for e in entries]
    tables = Tables(render(many, video=False))
    source = entries[0].source
    header, *rows = tables.cells["table-rmse"]
    assert [c[0] for c in header[1::5]] == [f"{n}, {u}" for n, u in zip(source.names, source.units)]
    for entry, row in zip(many, rows, strict=True):
        assert row[0][0] == entry.key
        expected = [v for i in range(2) for v in of_coordinate(entry.summary, i)]
        assert [float(value) for _, value in row[1:]] == expected
    key = many[1].key
    header, *rows = tables.cells[f"baseline {key}"]
    assert [row[0][0] for row in rows] == [e.key for e in many if e.key != key]
    found = {d.entry: d for d in pairs.differences(many) if d.baseline == key}
    column = [c[0] for c in header].index("hinge, rad")
    for row in rows:
        d = found[row[0][0]]
        assert float(row[column][1]) == d.rmse[0].difference.value
        assert float(row[column][2]) == d.p[1]


def test_an_estimator_that_lost_every_run_has_dashes(two):
    entries, _, _, _ = two
    record = {**entries[1].record, "diverged": np.ones_like(entries[1].record["diverged"])}
    source = entries[1].source
    summary = summarize(
        "ukf", record, list(source.runs), source.times, source.scenario.consistency, source.names,
        source.channels,
    )  # fmt: skip
    lost = replace(entries[1], record=record, summary=summary)
    page = render([entries[0], lost], video=False)
    shown = [cell[0] for table in Tables(page).cells.values() for row in table for cell in row]
    assert "–" in shown
    assert not [text for text in shown if "nan" in text]
    assert "12 of 12 runs diverged (100.0%)." in page


def test_runs_are_the_stored_ones(two):
    entries, _, page, _ = two
    for run, shown in page["runs"].items():
        for entry in entries:
            place = int(run)
            keep = np.searchsorted(entry.source.times, numbers(shown[entry.key]["time"])[0] - 1e-6)
            for name in ("error", "std"):
                stored = entry.group[name].values[place, keep].T.astype("f4")
                np.testing.assert_array_equal(numbers(shown[entry.key][name]), stored)


def test_the_page_is_whole_and_small(two):
    _, tables, page, text = two
    assert set(page["drawings"]) <= tables.ids
    assert tables.twice == []
    assert len(text) < 8e6
    own = text.replace(text[text.index("<script>") : text.rindex("<script>")], "")
    assert not re.findall(r'(?:src|href)="(?!#|data:)[^"]*"', own)
    assert "http://" not in own
    assert "https://" not in own


def test_a_summary_says_what_needs_traces(entries, tmp_path):
    page = render(entries("bare"))
    tables = Tables(page)
    words = " ".join(tables.words)
    assert "need `estbench run --keep diagonal`" in words
    assert {"nees", "nis", "rmse-0", "step-cost"} <= tables.ids
    assert ("innovations" in tables.ids) == ("lags" in SUMMARY)
    assert not {"error-0", "density-0", "nis-correlation", "table-outside"} & tables.ids
    assert {"coverage-1", "coverage-2", "coverage-3"} <= tables.ids
    (notice,) = [n for n in notices(entries("bare"), [None]) if "kept no traces" in n]
    assert "coverage" not in notice
    assert "the autocorrelation of NIS" in notice
    check_coverage(page_data(page), entries("bare")[0])
    assert page_data(page)["runs"] == {}


def test_diverged_runs_are_listed_with_step_and_cause(entries):
    (entry,) = entries("lost")
    lost = np.flatnonzero(~entry.good)
    assert len(lost)
    tables = Tables(render([entry], video=False))
    rows = tables.cells["diverged"][1:]
    assert [int(row[0][0]) for row in rows] == entry.source.runs[lost].tolist()
    section, times = entry.source.scenario.consistency, entry.source.times
    window = round(section.divergence_duration / np.diff(times).mean())
    for place, row in zip(lost, rows):
        above = entry.group["nees"].values[place] / entry.source.n > 2.0
        first = next(k for k in range(len(above)) if above[k : k + window].all())
        step = int(row[2][0])
        assert step == first  # where it left, not where that was noticed
        assert row[1][0] == f"{times[step]:g} s"
        assert "NEES/n above 2 for 0.05 s" in row[3][0]


def test_many_runs_are_thinned_for_drawing_only(entries, monkeypatch):
    pair = entries("two")
    monkeypatch.setattr(traces, "run_points", lambda entries: (2, 30))
    page = page_data(render(pair, video=False))
    assert len(page["runs"]) == 2
    assert all(numbers(r["ekf"]["time"]).size <= 32 for r in page["runs"].values())
    check_coverage(page, pair[0])


def test_names_are_escaped(store, tmp_path):
    import shutil

    folder = shutil.copytree(store("two"), tmp_path / "</script><b>x")
    other = shutil.copytree(store("two"), tmp_path / "y")
    page = render(sources.load([folder, other]), video=False)
    assert "<b>x" not in page.replace("\\u003c", "<").split('id="page-data"')[0]
    assert len(page_data(page)["entries"]) == 4


def test_where_it_is_written(store, tmp_path):
    from estbench.errors import StoreError

    path = write_report([store("bare")], tmp_path / "r.html")
    assert path.stat().st_size > 1e6
    with pytest.raises(StoreError, match="cannot be written"):
        write_report([store("bare")], tmp_path / "no" / "r.html")


def test_the_causes_stand_under_the_verdict(entries):
    """What `estbench explain` says, for each estimator that is not consistent."""
    (entry,) = entries("lost")
    found = of(entry.source, "ekf").findings
    assert found
    page = render([entry], video=False)
    panel = page.split('<ul class="causes">')[1].split("</ul>")[0]
    words = html.unescape(re.sub("<[^>]*>", "", panel))
    for cause in found:
        assert cause.text.replace("`", "") in words
        assert f"Usually helps: {cause.remedy.replace('`', '')}." in words
    judgement = replace(entry.summary.judgement, verdict=Verdict.CONSISTENT)
    consistent = replace(entry, summary=replace(entry.summary, judgement=judgement))
    assert 'class="causes"' not in render([consistent], video=False)
    del entry.source.records["ekf"]["scaled_square"]  # a store of an earlier version
    assert 'class="causes"' not in render([entry], video=False)


def test_the_error_budget_of_each_estimator(entries):
    """The shares of the table add up; an estimator without a gain has a reason in its place."""
    entry = entries("bare")[0]
    scenario = entry.source.scenario
    pf = scenario.model_copy(update={"estimators": {**scenario.estimators, "pf": {}}})
    other = replace(entry, key="pf", label="pf", source=replace(entry.source, scenario=pf))
    page = render([entry], video=False, budget=True)
    (none,) = budgets.budgets([other], lambda line: None)
    rows = Tables(page).cells["table-budget-0"]
    assert rows[0][0][0] == "source"
    named = {row[0][0]: row[2][0] for row in rows[1:]}
    assert {"encoder.noise", "gyro.noise", "initial", "process", "all"} <= named.keys()
    shares = [float(v.rstrip("%")) for name, v in named.items() if "%" in v and name != "all"]
    assert sum(shares) == pytest.approx(100.0, abs=0.3)
    assert "ParticleFilter shows no gain" in none.reason
    assert shares_of([none]) == []
    drawn = page_data(page)["drawings"]
    assert {"budget-0", "budget-0-0", "budget-0-1"} <= drawn.keys()
    assert 'id="budget"' not in render([entry], video=False)
