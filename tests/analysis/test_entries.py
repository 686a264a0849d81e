"""An estimator of an installed package gets rows in the table of entries."""

import csv
import importlib
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from estbench.analysis import entries
from estbench.errors import AnalysisError

ROOT = Path(__file__).parents[2]


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A distribution of another author, as pip leaves it: a module and its entry point."""
    site = tmp_path / "site"
    info = site / "steady_filter-1.2.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: steady-filter\nVersion: 1.2\n")
    (info / "entry_points.txt").write_text("[estbench.estimators]\nsteady = steady:MyFilter\n")
    shutil.copy(ROOT / "examples" / "my_filter.py", site / "steady.py")
    monkeypatch.syspath_prepend(site)
    importlib.invalidate_caches()
    yield "steady-filter"
    sys.modules.pop("steady", None)


def test_rows_are_appended_with_versions_and_cost(package, tmp_path):
    out = tmp_path / "entries.csv"
    (row,) = entries.enter(package, out, 3, ["pendulum"])
    assert (row["package_version"], row["reference"]) == ("1.2", "ekf")
    assert row["rmse_ratio"] > 1.2  # the gain of the first state, beside the EKF; here 2.4
    assert row["rmse_ratio_low"] < row["rmse_ratio"] < row["rmse_ratio_high"]
    assert row["cost_us_per_run_step"] > 0
    other = {"scenario": "pendulum", "estimator": "ukf", "package": "ukf", "package_version": ""}
    entries._write(out, [*entries._read(out), other])
    with out.open() as stream:
        first, second = csv.DictReader(stream)
    assert (first["estimator"], second["estimator"]) == ("steady", "ukf")
    assert first["mujoco"]
    assert first["anees_over_n"] == f"{row['anees_over_n']:.6g}"
    page = out.with_suffix(".md").read_text()
    assert page.count("| pendulum | ") == 2
    assert "steady-filter 1.2" in page


def test_an_estimator_that_does_not_fit_has_a_note(tmp_path):
    (row,) = entries.enter("contact_ekf", tmp_path / "e.csv", 2, ["pendulum"])
    assert "verdict" not in row
    assert "one is needed" in row["note"]


def test_a_recorded_log_has_a_row(tmp_path):
    folder = tmp_path / "real_pendulum"
    folder.mkdir()
    noise = np.random.default_rng(0).standard_normal((300, 2)) * [0.006, 0.1]
    rows = [f"{0.01 * k},{p},{v},0.0" for k, (p, v) in enumerate(noise)]  # hanging at rest
    (folder / "rest.csv").write_text("\n".join(["time,position,velocity,torque", *rows]))
    ((name, file),) = entries.recordings(tmp_path)
    row = entries._recorded(name, "ekf", "ekf", "ekf", file, lambda line: None)
    assert (row["log"], row["runs"], row["note"]) == ("rest", 1, "")
    assert 0.3 < row["anis_over_m"] < 1.5  # 600 values
    with pytest.raises(AnalysisError, match="has no real_pendulum"):
        entries.recordings(tmp_path / "none")


def test_names_that_bring_no_estimator(tmp_path):
    with pytest.raises(AnalysisError, match="no entry point of the group 'estbench"):
        entries.estimators_of("numpy")
    with pytest.raises(AnalysisError, match="no installed package or estimator 'no-such'"):
        entries.estimators_of("no-such")
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    with pytest.raises(AnalysisError, match="is no table of entries"):
        entries.enter("ukf", tmp_path / "other.csv", 4, ["pendulum"])
