"""Locks of a results folder, and removal of the files that killed writers left.

One process that writes alone holds `.lock` exclusively. Processes that write one store by `--shard`
hold it together, and each holds the lock of its own share. The system releases the locks of a
process that dies.
"""

import contextlib
import fcntl
import glob
import os
import re
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

Shard = tuple[int, int]
"""(i, n): the i-th of n shares, 1 <= i <= n; batch b is in share b mod n + 1."""


@contextmanager
def held(folder: Path, shard: Shard | None) -> Iterator[None]:
    """Hold the lock of the folder, or that of one share of it.

    Raises:
        BlockingIOError: another process holds it.
        OSError: the file system cannot lock.
    """
    with contextlib.ExitStack() as stack:
        names = [(".lock", fcntl.LOCK_EX if shard is None else fcntl.LOCK_SH)]
        if shard is not None:
            names.append((_share(shard), fcntl.LOCK_EX))
        for name, mode in names:
            file = stack.enter_context((folder / name).open("w"))
            fcntl.flock(file, mode | fcntl.LOCK_NB)
        yield


@contextmanager
def briefly(folder: Path) -> Iterator[None]:
    """Wait for the lock of what all shares write: the store's attributes and metadata.

    Raises:
        OSError: the file system cannot lock.
    """
    with (folder / ".lock-attributes").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def sweep(folder: Path, store: Path, shard: Shard | None) -> None:
    """Remove the unfinished files of killed writers; call it while the folder is `held`.

    zarr writes a chunk to a file `*.partial` and then renames it, so a writer that is killed in
    between leaves this file. A process that holds the folder alone removes all of them. A share
    removes those of its own batches, which no other process writes. Where locks of another count
    of shares exist, another process may write these batches, and nothing is removed.

    Args:
        folder: of the results.
        store: of the zarr store in it.
        shard: the share that is held, or None.
    """
    if shard is not None and any(
        not name.endswith(f"-of-{shard[1]}")
        for name in (p.name for p in folder.glob(".lock-*-of-*"))
    ):
        return
    for path in store.rglob("*.partial"):
        batch = re.search(r"/c/(\d+)[./]", path.relative_to(store).as_posix())
        if shard is None or (batch and int(batch[1]) % shard[1] == shard[0] - 1):
            path.unlink(missing_ok=True)


def draft(folder: Path) -> Path:
    """A hidden path beside a folder, at which it is built; drafts of killed writers are removed.

    A living writer holds the lock of its draft (`building`), which is not removed.
    """
    for old in folder.parent.glob(f".{glob.escape(folder.name)}.{'[0-9a-f]' * 8}"):
        with contextlib.suppress(OSError), (old / _DRAFT).open("r+") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(old)
    return folder.parent / f".{folder.name}.{uuid.uuid4().hex[:8]}"


@contextmanager
def building(draft: Path) -> Iterator[None]:
    """Make a draft, and lock it so that no other process removes it.

    Raises:
        OSError: it cannot be made, or the file system cannot lock.
    """
    draft.mkdir(parents=True)
    with (draft / ".lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        # Renamed while locked: no process finds the lock of a living draft free.
        os.rename(file.name, draft / _DRAFT)
        yield


_DRAFT = ".lock-draft"


def _share(shard: Shard) -> str:
    return f".lock-{shard[0]}-of-{shard[1]}"
