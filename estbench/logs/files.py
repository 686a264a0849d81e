"""The files of a log: text (CSV, TSV, columns between spaces) and npz."""

import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from estbench.errors import LogError, given_path
from estbench.logs import text
from estbench.logs.table import LogTable, from_arrays


def read(path: str | Path) -> LogTable:
    """The table of one file.

    Raises:
        LogError: there is no such file, or it is no table of numbers.
    """
    file = given_path("log", path, LogError)
    if not file.is_file():
        raise LogError(f"there is no log '{path}'; name a CSV, TSV or npz file")
    if file.suffix.lower() != ".npz":
        return text.read(file)
    try:
        with np.load(file, allow_pickle=False) as found:
            return from_arrays(file, {name: found[name] for name in found.files})
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise LogError(f"{file} is no npz file of arrays: {error}") from None


def read_all(paths: Sequence[str | Path]) -> list[LogTable]:
    """The tables of the files of one log.

    Raises:
        LogError: as `read`, or there is no file.
    """
    if not paths:
        raise LogError("no log is named; give at least one file")
    return [read(path) for path in paths]
