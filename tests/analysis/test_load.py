import shutil

import numpy as np
import pytest
import zarr

from estbench.analysis.load import load
from estbench.consistency import records
from estbench.consistency.summary import summarize
from estbench.errors import EstbenchError, StoreError
from tests.stores import unsealed


def test_a_whole_store_is_what_was_run(stores):
    results, stored = stores["a"], load(stores["a"].folder)
    assert (stored.names, stored.units) == (results.names, results.units)
    np.testing.assert_array_equal(stored.runs, results.runs)
    assert stored.total == 24
    assert stored.scenario == results.scenario
    assert list(stored.records) == ["ekf", "ukf", "kf", "ckf", "iekf", "sr_ekf"]
    for label, record in stored.records.items():
        assert set(record) == set(records.SUMMARY | records.COST)
        for name in records.SUMMARY:
            np.testing.assert_array_equal(record[name], results.records[label][name])
        # Cost is kept per batch, in text: equal but for rounding.
        assert stored.summaries[label].cost == pytest.approx(results[label].cost)
        assert stored.summaries[label].anees == results[label].anees


def test_only_finished_runs_count(stores, unfinished):
    results, stored = stores["a"], load(unfinished)
    done = np.r_[0:8, 16:24]
    np.testing.assert_array_equal(stored.runs, done)
    assert stored.total == 24
    for name, field in records.SUMMARY.items():
        rows = done if field.dims[0] == "run" else [0, 2]
        np.testing.assert_array_equal(
            stored.records["ekf"][name], results.records["ekf"][name][rows]
        )
    part = {k: v[done] for k, v in results.records["ekf"].items() if len(v) == 24}
    expected = summarize(
        "ekf", part, done.tolist(), stored.times, stored.scenario.consistency, stored.names,
        stored.channels,
    )  # fmt: skip
    assert stored.summaries["ekf"].rmse == expected.rmse
    assert stored.summaries["ekf"].runs == 16


def test_traces_batch_by_batch(stores, unfinished):
    stored = load(unfinished)
    traces = stored.traces("ekf")
    assert traces is not None
    found = list(traces)
    assert [len(error) for error, _ in found] == [8, 8]
    whole = stores["a"].records["ekf"]
    error, nees = (np.concatenate(parts) for parts in zip(*found))
    np.testing.assert_allclose((error**2).mean(axis=1), whole["mse"][np.r_[0:8, 16:24]])
    np.testing.assert_allclose(nees.mean(axis=1) / 4, whole["anees"][np.r_[0:8, 16:24]])
    assert load(stores["b"].folder).traces("ekf") is None


def test_traces_leave_diverged_runs_and_the_burn_in_out(stores, tmp_path):
    shutil.copytree(stores["a"].folder, tmp_path / "a")
    zarr.open_group(str(tmp_path / "a/data.zarr"), mode="r+")["ekf/diverged"][2:4] = True  # type: ignore[index]
    unsealed(tmp_path / "a")
    text = (tmp_path / "a/scenario.toml").read_text()
    assert "burn_in = 0.0" in text
    (tmp_path / "a/scenario.toml").write_text(text.replace("burn_in = 0.0", "burn_in = 0.1"))
    error, nees = next(iter(load(tmp_path / "a").traces("ekf") or ()))
    assert error.shape == (6, 10, 4)
    assert nees.shape == (6, 10)


def test_an_unknown_cost_is_not_zero(stores, tmp_path):
    shutil.copytree(stores["a"].folder, tmp_path / "a")
    shutil.rmtree(tmp_path / "a/costs")
    with pytest.raises(StoreError, match=r"costs/0\.json is missing; --resume"):
        load(tmp_path / "a")
    unsealed(tmp_path / "a")  # as an earlier version wrote it
    assert np.isnan(load(tmp_path / "a").summaries["ekf"].cost)


# What is no store


def foreign(folder):
    group = zarr.open_group(str(folder / "data.zarr"), mode="w")
    group.create_array("x", data=np.zeros(3), dimension_names=("x",))
    (folder / "scenario.toml").write_text("name = 'x'")


def empty(folder, source):
    shutil.copytree(source, folder, dirs_exist_ok=True)
    zarr.open_group(str(folder / "data.zarr"), mode="r+")["done"][:] = False  # type: ignore[index]


def without_scenario(folder, source):
    shutil.copytree(source, folder, dirs_exist_ok=True)
    (folder / "scenario.toml").unlink()


def without_array(folder, source):
    shutil.copytree(source, folder, dirs_exist_ok=True)
    unsealed(folder)
    shutil.rmtree(folder / "data.zarr/ekf/mse")
    for name in ("data.zarr/zarr.json", "data.zarr/ekf/zarr.json"):  # forget the consolidated list
        text = (folder / name).read_text()
        (folder / name).write_text(text if "mse" not in text else '{"zarr_format": 3, "node_type": '
                                   '"group", "attributes": {"estimators": ["ekf"]}}')  # fmt: skip


def corrupted(folder, source):
    shutil.copytree(source, folder, dirs_exist_ok=True)
    chunk = folder / "data.zarr/ekf/mse/c/1/0"
    chunk.write_bytes(b"x" * chunk.stat().st_size)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda f, s: None, "holds no data.zarr"),
        (lambda f, s: foreign(f), "not a store of estbench"),
        (empty, "no finished run yet"),
        (without_scenario, "scenario.toml is damaged or missing"),
        (without_array, "not a store of estbench: no .*mse"),
        (corrupted, "ekf/mse cannot be read"),
        (lambda f, s: (f / "data.zarr").mkdir(), "data.zarr"),
        (lambda f, s: (f / "data.zarr").write_text("?"), "holds no data.zarr"),
    ],
    ids=["empty", "foreign", "undone", "no scenario", "no array", "corrupt", "hollow", "a file"],
)
def test_what_is_no_store_is_said_in_one_line(stores, tmp_path, make, says):
    make(tmp_path, stores["a"].folder)
    with pytest.raises(StoreError, match=says) as error:
        load(tmp_path)
    assert str(tmp_path) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_broken_scenario_is_an_error_of_ours(stores, tmp_path):
    shutil.copytree(stores["a"].folder, tmp_path / "a")
    unsealed(tmp_path / "a")
    (tmp_path / "a/scenario.toml").write_text("name = ")
    with pytest.raises(EstbenchError, match="not valid TOML"):
        load(tmp_path / "a")
