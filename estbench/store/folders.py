"""The folders of results: names for new ones, and how they are made, whole or not at all."""

import contextlib
import itertools
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeVar

from filelock import Timeout

from estbench.errors import StoreError
from estbench.store import locks

T = TypeVar("T")
EXISTS = "{} exists; choose another --out, remove it, or go on with --resume"


@contextmanager
def named(name: str) -> Iterator[Path]:
    """A name for a new folder, `results/<name>-<time>`, the time in UTC to the second.

    No other process gets it within the block: where it is taken, `-2`, `-3`, ... is appended.

    Args:
        name: of the scenario.

    Raises:
        StoreError: the folder `results` cannot be written.
    """
    safe = re.sub(r"[^\w.-]+", "_", name).strip("._")
    first = Path("results") / f"{safe}-{datetime.now(UTC):%Y%m%dT%H%M%S}"
    others = (first.with_name(f"{first.name}-{n}") for n in itertools.count(2))
    made = missing_parents(first)
    with contextlib.ExitStack() as stack:
        try:
            first.parent.mkdir(exist_ok=True)
            stack.callback(remove, None, made)
            folder = next(f for f in itertools.chain([first], others) if _free(f, stack))
        except OSError as error:
            raise unwritable(first, error) from None
        yield folder


def _free(folder: Path, stack: contextlib.ExitStack) -> bool:
    """Whether a name is free; if it is, no other process finds it so until the stack is closed."""
    try:
        stack.enter_context(locks.passing(folder.with_name(f".{folder.name}.lock")))
    except Timeout:
        return False
    return not folder.exists()


@contextmanager
def built(folder: Path) -> Iterator[Path]:
    """A hidden path, at which a folder is built within the block; then it is renamed.

    So other processes see the whole folder or none; after an exception none is left.

    Args:
        folder: must not exist, or be empty.

    Raises:
        StoreError: the folder exists or cannot be written.
    """
    if taken(folder):
        raise StoreError(EXISTS.format(folder))
    made, draft = missing_parents(folder), locks.draft(folder)
    try:
        with locks.building(draft):
            yield draft
            with contextlib.suppress(OSError):
                folder.rmdir()  # it was empty
            draft.rename(folder)
    except BaseException as error:
        remove(draft, made)
        if not isinstance(error, OSError):
            raise
        if taken(folder):
            raise StoreError(EXISTS.format(folder)) from None
        raise unwritable(folder, error) from None


def opened(
    folder: Path, resume: bool, shared: bool, create: Callable[[], T], reopen: Callable[[], T]
) -> T:
    """A new store, or the one that is continued; of several shares the first makes it.

    Args:
        folder: of the store.
        resume: whether it may exist.
        shared: whether other processes may make it at the same time.
        create: makes it, and raises a `StoreError` if it exists.
        reopen: opens it.
    """
    if (resume or shared) and taken(folder):
        return reopen()
    try:
        return create()
    except StoreError:
        if not shared or not taken(folder):
            raise
        return reopen()


def taken(folder: Path) -> bool:
    """Whether something stands there; an empty folder is as good as none."""
    return folder.exists() and not (folder.is_dir() and not any(folder.iterdir()))


def missing_parents(folder: Path) -> list[Path]:
    """The folders that are made with a folder, the innermost first."""
    return [path for path in folder.parents if not path.exists()]


def remove(folder: Path | None, parents: Sequence[Path]) -> None:
    """Remove a folder, and the parents that were made for it if they are empty."""
    with contextlib.suppress(OSError):
        if folder is not None:
            shutil.rmtree(folder)
        for parent in parents:
            parent.rmdir()  # fails if it is not empty, and the folder stays


def unwritable(folder: Path, error: OSError) -> StoreError:
    """The error of a folder that cannot be made."""
    return StoreError(
        f"{folder} cannot be written: {error.strerror or error}; choose another --out"
    )
