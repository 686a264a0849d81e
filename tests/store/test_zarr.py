import re
import shutil
import tomllib
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import zarr

import estbench
from estbench.consistency import records
from estbench.errors import StoreError
from estbench.experiment import setup
from estbench.montecarlo.batch import run_batch
from estbench.scenario.load import load, resolve
from estbench.store.metadata import COPY, STORE
from estbench.store.zarr import Store
from tests.stores import unsealed

KEEP = ("summary", "diagonal", "full")


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Results of ten runs in batches of four, by what was kept."""
    folder = tmp_path_factory.mktemp("results")
    return {
        keep: estbench.run(
            "cartpole", ["ekf", "ukf"], runs=10, duration=0.2, seed=5, batch_size=4, workers=2,
            out=folder / keep, keep=keep,
        )
        for keep in KEEP
    }  # fmt: skip


def fresh(folder, keep="diagonal"):
    prepared = setup.build(resolve("cartpole", ["ekf"], runs=3, duration=0.1))
    return prepared, Store.create(folder, prepared, keep, 2)


# What is in it


@pytest.mark.parametrize("keep", KEEP)
def test_one_call_opens_everything_that_was_kept(written, keep):
    results = written[keep]
    with estbench.open_results(results.folder) as tree:
        assert set(tree.children) == {"ekf", "ukf"} | ({"truth"} if keep != "summary" else set())
        assert tree["done"].to_numpy().all()
        assert tree["done"].dtype == bool
        for label in ("ekf", "ukf"):
            assert set(tree[label].data_vars) == set(records.fields(keep))
            for name, field in records.fields(keep).items():
                variable = tree[label][name]
                assert variable.dims == field.dims
                assert variable.attrs["meaning"] == field.meaning
                assert variable.dtype == np.dtype(field.dtype)
                if name in records.SUMMARY:
                    np.testing.assert_array_equal(variable, results.records[label][name])


def test_coordinates_units_and_labels(written):
    with estbench.open_results(written["full"].folder) as tree:
        names = ["cart", "pole", "cart.vel", "pole.vel"]
        np.testing.assert_array_equal(tree["coordinate"], names)
        np.testing.assert_array_equal(tree["coordinate_"], names)
        np.testing.assert_array_equal(tree["unit"], ["m", "rad", "m/s", "rad/s"])
        np.testing.assert_array_equal(tree["run"], np.arange(10))
        np.testing.assert_allclose(tree["time"], 0.01 * np.arange(21), atol=1e-12)
        assert tree["time"].attrs["units"] == "s"
        pole = tree["ekf"]["error"].sel(run=3, coordinate="pole")
        assert pole.dims == ("time",)


def test_the_numbers_of_the_state_have_names(written, tmp_path):
    with estbench.open_results(written["diagonal"].folder) as tree:
        names = ["cart", "pole", "cart.vel", "pole.vel"]
        np.testing.assert_array_equal(tree["state"], names)
        pole = tree["truth/x"].sel(state="pole") - tree["ekf/estimate"].sel(state="pole")
        np.testing.assert_allclose(pole, tree["ekf/error"].sel(coordinate="pole"), atol=1e-12)
    with estbench.open_results(written["summary"].folder) as tree:
        assert "state" not in tree.coords
    turning = estbench.run("quadrotor", ["ekf"], runs=2, duration=0.05, out=tmp_path / "turning")
    with estbench.open_results(turning.folder) as tree:
        body = str(tree["coordinate"].values[0]).removesuffix(".x")
        parts = ("x", "y", "z", "qw", "qx", "qy", "qz", "vx", "vy", "vz", "wx", "wy", "wz")
        assert tree["state"].values.tolist() == [f"{body}.{part}" for part in parts]
        quaternion = tree["truth/x"].sel(state=[f"{body}.q{axis}" for axis in "wxyz"])
        np.testing.assert_allclose((quaternion**2).sum("state"), 1.0, atol=1e-12)


def test_a_store_whose_state_has_no_names_opens_and_is_gone_on_with(written, tmp_path):
    """As those written before they had: it is completed, and stays without."""
    options = {"runs": 10, "duration": 0.2, "seed": 5, "batch_size": 4, "keep": "diagonal"}
    folder = tmp_path / "before"
    shutil.copytree(written["diagonal"].folder, folder)
    path = folder / STORE
    shutil.rmtree(path / "state")
    unsealed(folder)
    group = zarr.open_group(str(path))
    group["done"][4:8] = False
    group["ekf/error"][4:8] = 0.0
    with estbench.open_results(folder) as tree:
        assert int(tree["done"].sum()) == 6
    estbench.run("cartpole", ["ekf", "ukf"], **options, out=folder, resume=True)
    with estbench.open_results(folder) as a, estbench.open_results(written["diagonal"].folder) as b:
        assert "state" not in a.coords
        for path in ("truth/x", "ekf/error", "ukf/anees"):
            np.testing.assert_array_equal(a[path], b[path])


def test_every_variable_is_in_the_documentation(written):
    docs = Path(__file__).parents[2] / "docs"
    rows = re.findall(
        r"^\| `(summary|diagonal|full)` \| `(\w+)` \| ([\w, ]+) \| \S.*? \| \S.* \|$",
        (docs / "batches.md").read_text(encoding="utf-8"), re.MULTILINE,
    )  # fmt: skip
    rows += [
        ("summary", name, dims)
        for name, dims in re.findall(
            r"^\| .* \| `(\w+)` \(([\w, ]+)\): \S.* \|$",
            (docs / "statistics.md").read_text(encoding="utf-8"), re.MULTILINE,
        )
    ]  # fmt: skip
    for keep in KEEP:
        with estbench.open_results(written[keep].folder) as tree:
            found = {str(k): ", ".join(map(str, v.dims)) for k, v in tree["ekf"].data_vars.items()}
        levels = KEEP[: KEEP.index(keep) + 1]
        listed = [(name, dims) for level, name, dims in rows if level in levels]
        assert sorted(found.items()) == sorted(set(listed))
    with estbench.open_results(written["full"].folder) as tree:
        assert {*tree.data_vars, *tree["truth"].data_vars} == {"done", "unit", "x"}


def test_a_finished_store_opens_by_one_file(written):
    group = zarr.open_consolidated(str(written["full"].folder / STORE))
    assert "error" in group["ekf"]


def test_attributes_say_where_it_comes_from(written):
    with estbench.open_results(written["summary"].folder) as tree:
        assert (tree.attrs["scenario"], tree.attrs["seed"]) == ("cartpole", 5)
        assert list(tree.attrs["estimators"]) == ["ekf", "ukf"]
        assert tree.attrs["versions"]["mujoco"] == version("mujoco")
        assert {"estbench", "numpy", "python"} <= set(tree.attrs["versions"])


def test_traces_fit_together(written):
    with estbench.open_results(written["full"].folder) as tree:
        ekf, x = tree["ekf"].to_dataset(), tree["truth"]["x"].to_numpy()
        assert np.isfinite(x).all()
        np.testing.assert_allclose(ekf["error"], x - ekf["estimate"].to_numpy(), atol=1e-12)
        P, error = ekf["cov"].to_numpy(), ekf["error"].to_numpy()
        np.testing.assert_allclose(ekf["std"] ** 2, np.diagonal(P, axis1=2, axis2=3))
        nees = np.einsum("rti,rtij,rtj->rt", error, np.linalg.inv(P), error)
        np.testing.assert_allclose(ekf["nees"], nees, rtol=1e-6)
        np.testing.assert_allclose(ekf["anees"], nees[:, 1:].mean(axis=1) / 4, rtol=1e-6)
        np.testing.assert_allclose(ekf["nees_sum"].sum("batch"), nees.sum(axis=0), rtol=1e-6)


def test_what_is_kept_does_not_change_the_numbers(written):
    a, b = (estbench.open_results(written[keep].folder) for keep in ("diagonal", "full"))
    with a, b:
        for name in set(records.DIAGONAL) | set(records.SUMMARY):
            np.testing.assert_array_equal(a["ekf"][name], b["ekf"][name])


def test_the_saved_scenario_is_the_resolved_one(written):
    path = written["summary"].folder / "scenario.toml"
    assert tomllib.loads(path.read_text())["simulation"] == {"duration": 0.2, "runs": 10, "seed": 5}
    assert load(written["summary"].folder) == written["summary"].scenario


def test_no_chunk_spans_two_batches(written):
    group = zarr.open_group(str(written["full"].folder / STORE), mode="r")
    for name, field in records.fields("full").items():
        chunks = dict(zip(field.dims, group[f"ekf/{name}"].chunks))
        assert chunks.get("batch", 1) == 1
        assert chunks.get("run", 4) == 4


# An unfinished one


def test_an_unfinished_store_is_readable(tmp_path):
    prepared, target = fresh(tmp_path / "x")
    batch = run_batch(prepared, [0, 1], "diagonal")
    target.write(0, batch.truth, batch.records)
    with estbench.open_results(tmp_path / "x") as tree:  # nobody closed it: think of kill -9
        np.testing.assert_array_equal(tree["done"], [True, True, False])
        np.testing.assert_array_equal(tree["ekf"]["error"][:2], batch.records["ekf"]["error"])
        assert np.isnan(tree["ekf"]["error"][2]).all()
        assert np.isnan(tree["ekf"]["nees_sum"][1]).all()


def test_done_is_set_last(tmp_path):
    prepared, target = fresh(tmp_path / "x")
    batch = run_batch(prepared, [0, 1], "diagonal")
    batch.records["ekf"]["no such array"] = np.zeros(2)
    with pytest.raises(KeyError):
        target.write(0, batch.truth, batch.records)
    with estbench.open_results(tmp_path / "x") as tree:
        assert not tree["done"].any()


# Where it cannot be


def test_a_folder_that_exists_is_not_touched(tmp_path):
    (tmp_path / "x").mkdir()
    (tmp_path / "x" / "thesis.txt").write_text("dear")
    with pytest.raises(StoreError, match=r"x exists; choose another --out, remove it"):
        fresh(tmp_path / "x")
    assert [p.name for p in (tmp_path / "x").iterdir()] == ["thesis.txt"]


def test_a_folder_that_appears_in_between_is_not_touched(tmp_path, monkeypatch):
    folder = tmp_path / "x"
    rename = Path.rename

    def late(self, target):
        target.mkdir()
        (target / "theirs.txt").write_text("")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", late)
    with pytest.raises(StoreError, match="x exists"):
        fresh(folder)
    assert (folder / "theirs.txt").exists()


@pytest.mark.parametrize("place", ["file", "file/x", "file/x/y"])
def test_under_a_file(place, tmp_path):
    (tmp_path / "file").write_text("dear")
    with pytest.raises(StoreError, match=r"exists|cannot be written: Not a directory; choose"):
        fresh(tmp_path / place)
    assert (tmp_path / "file").read_text() == "dear"


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_template_that_cannot_be_finished_is_removed(error, tmp_path, monkeypatch):
    def fail(*arguments):
        raise error

    monkeypatch.setattr("estbench.store.zarr.declare", fail)
    expected = StoreError if isinstance(error, OSError) else KeyboardInterrupt
    with pytest.raises(expected):
        fresh(tmp_path / "new" / "x")
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_while_writing(tmp_path, monkeypatch):
    _, target = fresh(tmp_path / "x")

    def fail(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(zarr.Array, "__setitem__", fail)
    with pytest.raises(StoreError, match="x cannot be written: No space left on device"):
        target.write(0, {"x": np.zeros((2, 11, 4))}, {})


def test_discard_removes_the_parents_it_made_and_no_others(tmp_path):
    (tmp_path / "old").mkdir()
    _, target = fresh(tmp_path / "old" / "new" / "x")
    target.discard()
    assert list((tmp_path / "old").iterdir()) == []
    _, target = fresh(tmp_path / "new" / "x")
    (tmp_path / "new" / "other").mkdir()
    target.discard()
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["other"]


# Opening


def test_opening_what_is_not_there(tmp_path):
    with pytest.raises(StoreError, match=r"holds no data\.zarr; name a folder that"):
        estbench.open_results(tmp_path)


def test_opening_a_broken_store(written, tmp_path):
    shutil.copytree(written["summary"].folder, tmp_path / "x")
    (tmp_path / "x" / STORE / "zarr.json").write_text("{")
    with pytest.raises(StoreError, match=r"zarr\.json is damaged or missing"):
        estbench.open_results(tmp_path / "x")
    (tmp_path / "x" / COPY).unlink()  # as a store of an earlier version
    with pytest.raises(StoreError, match="cannot be read"):
        estbench.open_results(tmp_path / "x")
