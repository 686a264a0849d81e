import shutil

import numpy as np
import pytest
import zarr

from estbench.consistency import summary as statistics
from estbench.errors import StoreError
from estbench.report import sources


def test_summaries_are_those_of_the_run(store, tmp_path):
    import estbench

    results = estbench.run(
        "pendulum", ["ekf", "ukf"], runs=12, duration=1.0, out=tmp_path / "a", batch_size=5
    )
    for entry, summary in zip(sources.load([tmp_path / "a"]), results.summaries, strict=True):
        assert entry.key == summary.label
        assert entry.summary.anees == summary.anees
        assert entry.summary.rmse == summary.rmse
        assert entry.summary.verdict == summary.verdict
        np.testing.assert_array_equal(entry.source.runs, results.runs)


def test_an_unfinished_store_counts_its_finished_batches_only(store, tmp_path):
    folder = shutil.copytree(store("two"), tmp_path / "part")
    root = zarr.open_group(str(folder / "data.zarr"), mode="r+")
    root["done"][5:10] = False  # pyright: ignore[reportIndexIssue, reportArgumentType]
    root["ekf/nees_sum"][1] = np.nan  # pyright: ignore[reportIndexIssue, reportArgumentType]
    (entry, _), (whole, _) = sources.load([folder]), sources.load([store("two")])
    kept = [0, 1, 2, 3, 4, 10, 11]
    assert entry.source.runs.tolist() == kept
    assert (entry.source.total, len(entry.source.batches)) == (12, 2)
    np.testing.assert_array_equal(entry.record["anees"], whole.record["anees"][kept])
    assert np.isfinite(entry.record["nees_sum"]).all()
    again = statistics.summarize(
        "ekf",
        entry.record,
        kept,
        entry.source.times,
        entry.source.scenario.consistency,
        entry.source.names,
        entry.source.channels,
    )
    assert entry.summary.anees == again.anees
    assert entry.position(3) == 3
    assert entry.position(6) is None


def test_several_folders(store, tmp_path):
    other = shutil.copytree(store("two"), tmp_path / "two")
    entries = sources.load([store("two"), other])
    assert len({e.key for e in entries}) == 4  # same folder name: told apart by the parent
    assert entries[0].key.endswith("two/ekf")
    with pytest.raises(StoreError, match="named twice"):
        sources.load([other, other])
    with pytest.raises(StoreError, match="read stores of one robot together"):
        sources.load([other, store("full")])


def test_bad_folders(store, tmp_path):
    with pytest.raises(StoreError, match=r"holds no data\.zarr"):
        sources.load([tmp_path])
    with pytest.raises(StoreError, match=r"no estimator 'ukff'.*did you mean 'ukf'"):
        sources.load([store("two")], ["ukff"])
    foreign = tmp_path / "foreign"
    group = zarr.open_group(str(foreign / "data.zarr"), mode="w")
    group.create_array("x", data=np.zeros(3), dimension_names=("a",))
    with pytest.raises(StoreError, match=r"holds no scenario\.toml"):
        sources.load([foreign])
    shutil.copy(store("two") / "scenario.toml", foreign)
    with pytest.raises(StoreError, match="not a store of estbench"):
        sources.load([foreign])
    empty = shutil.copytree(store("two"), tmp_path / "empty")
    zarr.open_group(str(empty / "data.zarr"), mode="r+")["done"][:] = False  # pyright: ignore[reportIndexIssue, reportArgumentType]
    with pytest.raises(StoreError, match="no finished run"):
        sources.load([empty])
