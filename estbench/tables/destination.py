"""A file that is to be written: what is wrong with its path is said before the work, not after."""

import os
from pathlib import Path

from estbench.errors import StoreError


def check_file(path: Path) -> None:
    """Refuse a path at which no file can be written.

    Args:
        path: of the file, which may be there already.

    Raises:
        StoreError: its folder is not there, it is a folder itself, or writing is not allowed.
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
