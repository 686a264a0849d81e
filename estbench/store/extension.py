"""More runs for a store: its arrays are declared longer, and what is finished stays as it is.

The last batch, if it was shorter than the others, becomes a whole one and is computed again.
"""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from estbench.errors import StoreError
from estbench.store import locks, metadata

PATIENCE = 2.0
"""Seconds within which another share of the same run has extended the store."""


def is_longer(differences: Sequence[tuple[str, Any, Any]]) -> bool:
    """Whether two scenarios differ in their count of runs only, and the second has more.

    Args:
        differences: from `scenario.load.changes`.
    """
    if [key for key, *_ in differences] != ["simulation.runs"]:
        return False
    _, was, asked = differences[0]
    return isinstance(was, int) and asked > was


def extend(
    folder: Path, texts: Mapping[str, str], labels: metadata.Labels, lengths: Mapping[str, int]
) -> None:
    """Extend a store; of several shares that begin at once the first one does it.

    Args:
        folder: of the results.
        texts: name of a file beside the store -> what it is to hold.
        labels: of the longer store.
        lengths: dimension -> its new length.

    Raises:
        StoreError: another process is writing to it, or it takes no more runs.
        OSError: the folder cannot be written.
    """
    until = time.monotonic() + PATIENCE
    while True:
        try:
            with locks.held(folder, None):
                metadata.lengthen(folder, texts, labels, lengths)
            return
        except BlockingIOError:
            if metadata.holds(folder, texts):
                return
            if time.monotonic() > until:
                raise StoreError(
                    f"another process is writing to {folder}; wait for it before you add runs"
                ) from None
            time.sleep(0.05)
