"""Parquet files as tables, read by `pyarrow`."""

from pathlib import Path

import numpy as np

from estbench.errors import LogError, MissingExtraError
from estbench.logs.table import LogTable, from_arrays


def read(path: Path) -> LogTable:
    """The columns of numbers; those of time stamps in s since their first.

    Raises:
        LogError: it cannot be read, or is empty.
        MissingExtraError: pyarrow is not installed.
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        raise MissingExtraError("pyarrow", "logs") from None
    try:
        table = pq.read_table(path)
    except (OSError, pa.ArrowException) as error:
        why = " ".join(str(error).split())[:150]
        raise LogError(f"{path} is no Parquet file, or is cut off: {why}") from None
    arrays = {}
    for name in table.column_names:
        column = table.column(name)
        if pa.types.is_timestamp(column.type):
            ticks = np.asarray(column.cast(pa.timestamp("ns")).cast(pa.int64()).to_numpy())
            arrays[name] = (ticks - ticks[0]) * 1e-9 if len(ticks) else ticks
        elif pa.types.is_integer(column.type) or pa.types.is_floating(column.type):
            arrays[name] = np.asarray(column.to_numpy(), np.float64)
        elif pa.types.is_boolean(column.type):
            arrays[name] = np.asarray(column.cast(pa.int8()).to_numpy(), np.float64)
    return from_arrays(path, arrays)
