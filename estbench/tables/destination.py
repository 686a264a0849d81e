"""Check of the path of an output file, before the computation that fills it."""

import os
from pathlib import Path

from estbench.errors import StoreError


def check_file(path: Path) -> None:
    """Check that a file can be written at a path.

    Args:
        path: of the file, which may exist.

    Raises:
        StoreError: its folder does not exist, it is a folder, or writing is not allowed.
    """
    if not path.parent.is_dir():
        wrong = f"there is no folder {path.parent}; make it, or choose another --out"
    elif path.is_dir():
        wrong = "it is a folder; choose a file in it by --out"
    elif not os.access(path if path.exists() else path.parent, os.W_OK):
        wrong = "Permission denied; choose another --out"
    else:
        return
    raise StoreError(f"{path} cannot be written: {wrong}")
