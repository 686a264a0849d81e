"""Locks of a results folder, and removal of the files that killed writers left.

One process that writes alone holds `.lock`. Processes that write one store by `--shard` hold the
lock of their own share each, while nobody holds `.lock`. The system releases the locks of a process
that dies; filelock has them on every system.
"""

import contextlib
import glob
import re
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

Shard = tuple[int, int]
"""(i, n): the i-th of n shares, 1 <= i <= n; batch b is in share b mod n + 1."""


def _lock(path: Path, wait: bool = False) -> FileLock:
    """A lock of which each object is another holder; the file stays."""
    return FileLock(
        path, -1 if wait else 0, thread_local=False, fallback_to_soft=False, preserve_lock_file=True
    )


@contextmanager
def passing(path: Path) -> Iterator[None]:
    """Hold a lock whose file goes with it.

    The file is removed before the lock is released where the system allows it, as POSIX does;
    Windows removes it after.
    """
    with FileLock(path, 0, thread_local=False, fallback_to_soft=False):
        try:
            yield
        finally:
            with contextlib.suppress(OSError):
                path.unlink()


@contextmanager
def held(folder: Path, shard: Shard | None) -> Iterator[None]:
    """Hold the lock of the folder, or that of one share of it.

    Raises:
        BlockingIOError: another process holds it.
        OSError: the file system cannot lock.
    """
    alone, others = _lock(folder / ".lock"), sorted(folder.glob(".lock-*-of-*"))
    with contextlib.ExitStack() as stack:
        try:
            # One after the other, so that no process finds what another one only tries.
            with briefly(folder):
                if shard is None:
                    stack.enter_context(alone)
                    for path in others:
                        _lock(path).acquire().lock.release()
                else:
                    alone.acquire().lock.release()
                    stack.enter_context(_lock(folder / _share(shard)))
        except Timeout as error:
            raise BlockingIOError(f"{error.lock_file} is held") from None
        yield


@contextmanager
def briefly(folder: Path) -> Iterator[None]:
    """Wait for the lock of what all shares write: the store's attributes and metadata.

    Raises:
        OSError: the file system cannot lock.
    """
    with _lock(folder / ".lock-attributes", wait=True):
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
    for lock in folder.parent.glob(f".{glob.escape(folder.name)}.{'[0-9a-f]' * 8}.lock"):
        with contextlib.suppress(OSError), passing(lock):
            shutil.rmtree(lock.with_suffix(""), ignore_errors=True)
    return folder.parent / f".{folder.name}.{uuid.uuid4().hex[:8]}"


@contextmanager
def building(draft: Path) -> Iterator[None]:
    """Make a draft, and hold the lock beside it, so that no other process removes it.

    Raises:
        OSError: it cannot be made, or the file system cannot lock.
    """
    draft.parent.mkdir(parents=True, exist_ok=True)
    with passing(draft.with_name(f"{draft.name}.lock")):
        draft.mkdir()
        yield


def _share(shard: Shard) -> str:
    return f".lock-{shard[0]}-of-{shard[1]}"
