"""The files of a log: text (CSV, TSV, columns between spaces), npz, Parquet, rosbags."""

import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from estbench.errors import LogError, given_path
from estbench.logs import bags, parquet, text
from estbench.logs.table import LogTable, from_arrays


def read(path: str | Path) -> list[LogTable]:
    """The table of one file; of a bag one for each topic.

    Raises:
        LogError: there is no such file, or it has no numbers.
        MissingExtraError: its format needs the extra `logs`.
    """
    file = given_path("log", path, LogError)
    if file.exists() and bags.is_bag(file):
        return bags.read(file)
    if not file.is_file():
        raise LogError(f"there is no log '{path}'; name a CSV, TSV, npz or Parquet file, or a bag")
    match file.suffix.lower():
        case ".npz":
            return [_arrays(file)]
        case ".parquet" | ".pq":
            return [parquet.read(file)]
        case _:
            return [text.read(file)]


def _arrays(file: Path) -> LogTable:
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
    return [table for path in paths for table in read(path)]
