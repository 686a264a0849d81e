"""Who may write into a results folder, and what a writer that was killed left in it or beside it.

A process alone holds `.lock` exclusively; processes that share a store by `--shard` hold it
together, and each the lock of its own share. The system frees a lock when its process dies.
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
    """Hold the folder alone, or one share of it.

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
    """Wait for one's turn to change what all shares write: the store's attributes.

    Raises:
        OSError: the file system cannot lock.
    """
    with (folder / ".lock-attributes").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def sweep(folder: Path, store: Path, shard: Shard | None) -> None:
    """Remove the files that dead writers left unfinished; call it where the folder is `held`.

    A chunk is written beside its place as `*.partial` and then renamed, so that a writer which is
    killed in between leaves that file for ever. Who holds the folder alone owns them all. A share
    owns those of its own batches, as nobody else writes them; where the store has also been split
    into another count of shares somebody else may, and nothing is removed.
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
    """A hidden name beside a folder, to build it under; drafts that dead writers left are removed.

    A draft whose writer lives is locked by it (`building`), and stays.
    """
    for old in folder.parent.glob(f".{glob.escape(folder.name)}.{'[0-9a-f]' * 8}"):
        with contextlib.suppress(OSError), (old / _DRAFT).open("r+") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(old)
    return folder.parent / f".{folder.name}.{uuid.uuid4().hex[:8]}"


@contextmanager
def building(draft: Path) -> Iterator[None]:
    """Make a draft and keep others from removing it.

    Raises:
        OSError: it cannot be made, or the file system cannot lock.
    """
    draft.mkdir(parents=True)
    with (draft / ".lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        # Named when it is locked: nobody finds the lock of a living draft free.
        os.rename(file.name, draft / _DRAFT)
        yield


_DRAFT = ".lock-draft"


def _share(shard: Shard) -> str:
    return f".lock-{shard[0]}-of-{shard[1]}"
