"""A store takes more runs, and is then the one of an experiment that had them from the start."""

import shutil

import pytest

from estbench.errors import StoreError
from estbench.experiment import setup
from estbench.store import extension, metadata
from estbench.store.zarr import Store
from tests.store.test_metadata import contents
from tests.stores import run

OPTIONS = {"duration": 0.1, "batch_size": 3}


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    """One of 4 runs, of which the last batch is a part, and one of 9."""
    folder = tmp_path_factory.mktemp("stores")
    for runs in (4, 9):
        run(folder / str(runs), runs=runs, **OPTIONS)
    return folder / "4", folder / "9"


@pytest.fixture
def few(stores, tmp_path):
    shutil.copytree(stores[0], tmp_path / "x")
    return tmp_path / "x"


def test_every_file_is_that_of_the_runs_asked_for_at_once(stores, few):
    seen = []
    results = run(few, runs=9, resume=True, progress=lambda *n: seen.append(n), **OPTIONS)
    assert seen[-1] == (6, 6)  # the partial batch is computed again
    assert contents(few) == contents(stores[1])
    assert len(results.runs) == 9
    assert not results.notices
    with pytest.raises(StoreError, match=r"has 9 runs and 4 are asked for"):
        run(few, runs=4, resume=True, **OPTIONS)


def test_shares_extend_it_too(stores, few):
    run(few, runs=9, shard=(1, 2), **OPTIONS)
    assert len(run(few, runs=9, shard=(2, 2), **OPTIONS).runs) == 9
    assert contents(few) == contents(stores[1])


def test_an_extension_that_was_killed_is_completed(stores, few, monkeypatch):
    def killed(folder, texts):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(metadata, "_restore", lambda folder, texts: [])  # nothing is damaged yet
        patch.setattr(extension.metadata, "_put", _then(metadata._put, killed))
        with pytest.raises(KeyboardInterrupt):
            run(few, runs=9, resume=True, **OPTIONS)
    assert contents(few)["data.zarr/zarr.json"] == contents(stores[1])["data.zarr/zarr.json"]
    assert contents(few)["scenario.toml"] != contents(stores[1])["scenario.toml"]
    run(few, runs=9, resume=True, **OPTIONS)
    assert contents(few) == contents(stores[1])


def _then(first, second):
    def both(*args):
        first(*args)
        second(*args[:2])

    return both


def test_what_cannot_be_extended_stays_as_it_is(few, monkeypatch):
    monkeypatch.setattr(extension, "PATIENCE", 0.0)
    before = contents(few)
    for options, message in (
        ({"runs": 9, "seed": 1}, r"simulation\.seed was 0 and is 1|simulation\.runs was 4"),
        ({"runs": 9, "keep": "full"}, "keep was 'diagonal' and is 'full'"),
    ):
        with pytest.raises(StoreError, match=message):
            run(few, resume=True, **{**OPTIONS, **options})
    prepared = setup.build(run(few, runs=4, resume=True, **OPTIONS).scenario)
    with (
        Store.reopen(few, prepared).lock((1, 2)),
        pytest.raises(StoreError, match="another process is writing"),
    ):
        run(few, runs=9, shard=(2, 2), **OPTIONS)
    assert contents(few) == before
