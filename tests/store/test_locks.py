"""What killed writers leave in a store is removed, what living ones are writing is not."""

import subprocess
import sys
from pathlib import Path

import pytest

from estbench.errors import StoreError
from estbench.experiment import setup
from estbench.store import locks
from estbench.store.metadata import STORE
from estbench.store.zarr import Store
from tests.stores import run, same

PARTIAL = "0123456789abcdef.partial"
METADATA = f"zarr.{PARTIAL}"
FIRST = f"ekf/nees/c/0/0.{PARTIAL}", f"done/c/0.{PARTIAL}", f"ekf/mse/c/6/0.{PARTIAL}"
SECOND = f"ekf/error/c/1/0/0.{PARTIAL}", f"ekf/anees/c/11.{PARTIAL}"
"""Of the batches of the first and of the second share of two."""


def litter(folder):
    """Unfinished files of every batch and of the metadata; a function that lists what is left."""
    names = {METADATA, *FIRST, *SECOND}
    for name in names:
        path = folder / STORE / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"half a chu")
    return lambda: {name for name in names if (folder / STORE / name).exists()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return run(tmp_path_factory.mktemp("whole") / "x")


def test_a_process_alone_owns_every_unfinished_file(whole, tmp_path):
    run(tmp_path / "x")
    left = litter(tmp_path / "x")
    run(tmp_path / "x", resume=True)
    assert left() == set()
    same(tmp_path / "x", whole.folder)


def test_a_share_owns_those_of_its_own_batches(whole, tmp_path):
    folder = tmp_path / "x"
    run(folder, shard=(1, 2))
    left = litter(folder)
    with Store.reopen(folder, setup.build(whole.scenario)).lock((1, 2)):
        assert left() == {METADATA, *SECOND}
        left = litter(folder)  # as if the first share, which lives, were writing them
        run(folder, shard=(2, 2))
        assert left() == {METADATA, *FIRST}
    run(folder, resume=True)
    assert left() == set()
    same(folder, whole.folder)


def test_shares_of_another_split_remove_nothing(whole, tmp_path):
    folder = tmp_path / "x"
    run(folder, shard=(1, 2))
    left = litter(folder)
    with Store.reopen(folder, setup.build(whole.scenario)).lock((3, 4)):
        assert left() == {METADATA, *FIRST, *SECOND}


HOLD = """
import sys
from pathlib import Path
from estbench.store import locks
with locks.held(Path(sys.argv[1]), None):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_while_another_process_lives_nothing_is_removed(tmp_path):
    folder = tmp_path / "x"
    run(folder)
    left = litter(folder)
    command = [sys.executable, "-c", HOLD, str(folder)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"held\n"
        for shard in (None, (1, 2)):
            with pytest.raises(StoreError, match="another process is writing"):
                run(folder, resume=True, shard=shard)
        assert left() == {METADATA, *FIRST, *SECOND}
        process.kill()
    run(folder, resume=True)
    assert left() == set()


BUILD = """
import sys
from pathlib import Path
from estbench.store import locks
draft = locks.draft(Path(sys.argv[1]))
with locks.building(draft):
    (draft / "costs").mkdir()
    print(draft, flush=True)
    sys.stdin.read()
"""


def test_the_drafts_of_dead_writers_are_removed_and_no_others(tmp_path):
    folder = tmp_path / "x"
    others = {tmp_path / f".{name}.0123abcd" for name in ("y", "x.y")} | {tmp_path / ".x.notours"}
    for other in others:
        other.mkdir()
        (other / ".lock-draft").touch()
    command = [sys.executable, "-c", BUILD, str(folder)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        theirs = Path(process.stdout.readline().decode().strip())
        mine = locks.draft(folder)
        assert theirs != mine
        assert (theirs / "costs").is_dir()
        process.kill()
    run(folder, runs=5)
    assert set(tmp_path.iterdir()) == {folder, *others}


def test_a_folder_name_that_looks_like_a_batch(tmp_path):
    folder = tmp_path / "c" / "1"
    (folder / STORE / "done" / "c").mkdir(parents=True)
    theirs = folder / STORE / "done" / "c" / f"0.{PARTIAL}"
    theirs.touch()
    with locks.held(folder, (2, 2)):
        locks.sweep(folder, folder / STORE, (2, 2))
    assert theirs.exists()
