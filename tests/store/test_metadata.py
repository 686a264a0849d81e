"""What is damaged beside the runs is recognized by whoever reads it, and written again."""

import shutil
from pathlib import Path

import pytest

import estbench
from estbench.analysis.load import load
from estbench.errors import StoreError
from estbench.store.metadata import COPY, STORE, is_sealed
from tests.stores import run, unsealed

OPTIONS = {"runs": 4, "batch_size": 2, "duration": 0.1}
READ = (
    f"{STORE}/unit/c/0", f"{STORE}/coordinate/c/0", f"{STORE}/phase/c/0", f"{STORE}/time/c/0",
    f"{STORE}/zarr.json", "scenario.toml", "costs/1.json",
)  # fmt: skip
"""Files without which a store cannot be understood."""
REST = f"{STORE}/ekf/nees/zarr.json", COPY
"""Files that `open_results` does not need."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "x"
    run(folder, **OPTIONS)
    return folder


def flip(path: Path) -> None:
    """Change one digit, or the lowest bit of a byte in the middle."""
    content = bytearray(path.read_bytes())
    digits = [i for i, byte in enumerate(content) if chr(byte).isdigit()]
    content[digits[-1] if path.suffix in (".json", ".toml") else len(content) // 2] ^= 1
    path.write_bytes(content)


def zero(path: Path) -> None:
    path.write_bytes(bytes(path.stat().st_size))


def contents(folder: Path) -> dict[str, bytes]:
    """Every file but locks and costs, which differ from run to run."""
    return {
        str(p.relative_to(folder)): p.read_bytes()
        for p in folder.rglob("*")
        if p.is_file() and not p.name.startswith(".lock") and p.parent.name != "costs"
    }


def test_a_damaged_file_is_named_by_the_reader(whole, tmp_path):
    for i, (name, damage) in enumerate(zip(READ, 3 * (flip, zero, Path.unlink))):
        folder = tmp_path / str(i)
        shutil.copytree(whole, folder)
        damage(folder / name)
        named = str(folder / name).removesuffix("/c/0")
        with pytest.raises(StoreError) as caught:
            load(folder)
        assert named in str(caught.value)
        assert "--resume" in str(caught.value)


@pytest.mark.parametrize("damage", [flip, Path.unlink])
def test_resume_writes_all_of_it_again(whole, tmp_path, damage):
    folder = tmp_path / "x"
    shutil.copytree(whole, folder)
    damaged = [name for name in (*READ, *REST) if name != COPY]
    for name in damaged:
        damage(folder / name)
    results = run(folder, **OPTIONS, resume=True)
    said = "\n".join(results.notices)
    for name in damaged[:-3]:
        assert f"{name.removesuffix('/c/0')} was damaged and has been written again" in said
    assert "batch 1 of the store was corrupted" in said
    assert contents(folder) == contents(whole)
    assert not run(folder, **OPTIONS, resume=True).notices
    damage(folder / COPY)
    assert load(folder).total == 4
    run(folder, **OPTIONS, resume=True)
    assert contents(folder) == contents(whole)


def test_what_nothing_restores_is_refused_by_name(whole, tmp_path):
    shutil.copytree(whole, tmp_path / "a")
    shutil.copytree(whole, tmp_path / "b")
    flip(tmp_path / "a" / "scenario.toml")
    before = contents(tmp_path / "a")
    with pytest.raises(
        StoreError, match=r"a/scenario\.toml is damaged: .*resume with the scenario"
    ):
        run(tmp_path / "a", **OPTIONS, seed=1, resume=True)
    assert contents(tmp_path / "a") == before
    for name in (f"{STORE}/zarr.json", COPY):
        flip(tmp_path / "b" / name)
    with pytest.raises(StoreError, match=r"data\.zarr/zarr\.json and .*metadata\.json are damaged"):
        run(tmp_path / "b", **OPTIONS, resume=True)


def test_a_chunk_that_is_missing_is_named_by_the_reader(whole, tmp_path):
    shutil.copytree(whole, tmp_path / "x")
    chunk = tmp_path / "x" / STORE / "ekf" / "nees" / "c" / "1" / "0"
    chunk.unlink()
    with pytest.raises(StoreError, match=r"ekf/nees/c/1/0 is missing; --resume"):
        load(tmp_path / "x")


def test_labels_of_a_store_without_checksums_are_restored(whole, tmp_path):
    shutil.copytree(whole, tmp_path / "x")
    unsealed(tmp_path / "x")
    assert not is_sealed(tmp_path / "x")
    (tmp_path / "x" / STORE / "unit" / "c" / "0").unlink()
    with estbench.open_results(tmp_path / "x") as tree:
        assert set(tree["unit"].values) == {""}
    run(tmp_path / "x", **OPTIONS, resume=True)
    with estbench.open_results(tmp_path / "x") as tree:
        assert list(tree["unit"].values) == ["rad", "rad/s"]


def test_a_study(tmp_path):
    def sweep(resume=False):
        return estbench.sweep(
            "pendulum", ["filter.process_noise_scale=0.5,2"], "ekf", runs=4, duration=0.1,
            out=tmp_path / "x", resume=resume,
        )  # fmt: skip

    sweep()
    before = contents(tmp_path / "x")
    names = [
        f"{STORE}/filter.process_noise_scale/c/0", f"{STORE}/coordinate/c/0", "study.json",
        "scenario.toml", f"{STORE}/zarr.json",
    ]  # fmt: skip
    for name in reversed(names):
        flip(tmp_path / "x" / name)
        with pytest.raises(StoreError, match=r"is damaged or missing.*--resume"):
            estbench.open_study(tmp_path / "x")
    notices = "\n".join(sweep(resume=True).notices)
    assert all(name.removesuffix("/c/0") in notices for name in names)
    assert contents(tmp_path / "x") == before
