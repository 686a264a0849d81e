"""Rosbags (rosbag1, rosbag2 in sqlite or MCAP) as tables: one for each topic, read by `rosbags`.

The columns of a topic are `TOPIC.FIELD`, such as `/imu/data.angular_velocity.x`: every field that
is a number, by its path; `[i]` of an array, or the name where the message has as many names, as in
`/joint_states.position.elbow`. `stamp` is the time of the header, `received` that of the recorder,
both in s since the first of any.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from estbench.errors import LogError, MissingExtraError
from estbench.logs.table import LogTable

SUFFIXES = (".bag", ".mcap", ".db3")
LONGEST = 64
"""Numbers of an array that is read; longer ones are pictures and the like."""
STAMP, RECEIVED = "stamp", "received"

Path_ = tuple[str | int, ...]


def is_bag(path: Path) -> bool:
    """Whether a path is that of a rosbag."""
    return path.suffix.lower() in SUFFIXES or (path / "metadata.yaml").is_file()


def read(path: Path) -> list[LogTable]:
    """The topics of a bag that have numbers.

    Raises:
        LogError: it cannot be read, is cut off, or has no message with numbers.
        MissingExtraError: rosbags is not installed.
    """
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise MissingExtraError("rosbags", "logs") from None
    bag = path.parent if path.suffix.lower() in (".mcap", ".db3") else path
    if bag.is_dir() and not (bag / "metadata.yaml").is_file():
        raise LogError(f"{path} has no metadata.yaml beside it; name the folder of the rosbag2")
    topics: dict[str, _Topic] = {}
    done = 0
    try:
        with AnyReader([bag], default_typestore=get_typestore(Stores.LATEST)) as reader:
            for connection, received, raw in reader.messages():
                message = reader.deserialize(raw, connection.msgtype)
                topic = topics.setdefault(connection.topic, _Topic(connection.topic))
                topic.add(message, received)
                done += 1
    except LogError:
        raise
    except Exception as error:  # rosbags, sqlite, struct and the decompressors have their own
        why = " ".join(str(error).split())[:150] or type(error).__name__
        where = f" after message {done}" if done or not isinstance(error, AnyReaderError) else ""
        raise LogError(f"{path} cannot be read{where} ({why}); is it cut off?") from None
    found = [topic for topic in topics.values() if topic.paths]
    if not found:
        raise LogError(f"{path} is empty: it has no message with numbers")
    begin = min(min(topic.stamps + topic.received) for topic in found)
    return [topic.table(path, begin) for topic in found]


class _Topic:
    """The messages of one topic."""

    def __init__(self, name: str):
        self.name = name
        self.paths: list[Path_] = []
        self.names: list[str] = []
        self.rows: list[list[float]] = []
        self.stamps: list[int] = []
        self.received: list[int] = []
        self._lengths = set[tuple[int, ...]]()

    def add(self, message: Any, received: int) -> None:
        """Add a message; fields that the ones before it lack are added too."""
        lengths = tuple(
            len(value) for value in vars(message).values() if isinstance(value, np.ndarray | list)
        )
        if lengths not in self._lengths:
            self._lengths.add(lengths)
            for path, name in _numbers(message, (), ()):
                if path not in self.paths:
                    self.paths.append(path)
                    self.names.append(name)
        self.rows.append([_at(message, path) for path in self.paths])
        header = getattr(message, "header", None)
        stamp = 0 if header is None else header.stamp.sec * 10**9 + header.stamp.nanosec
        self.stamps.append(stamp or received)
        self.received.append(received)

    def table(self, path: Path, begin: int) -> LogTable:
        """The table of the topic, times in s since `begin`, ns."""
        values = np.full((len(self.rows), len(self.paths)), np.nan)
        for row, numbers in zip(values, self.rows):
            row[: len(numbers)] = numbers
        columns = {f"{self.name}.{name}": values[:, i] for i, name in enumerate(self.names)}
        for name, times in ((STAMP, self.stamps), (RECEIVED, self.received)):
            columns[name] = (np.array(times, np.int64) - begin) * 1e-9
        return LogTable(path, columns, np.arange(1, len(values) + 1), topic=self.name)


def _numbers(
    value: Any, path: Path_, labels: tuple[str, ...], spoken: str = ""
) -> Iterator[tuple[Path_, str]]:
    """Where a message has numbers, and what the columns are called."""
    if isinstance(value, bool | int | float | np.number):
        yield path, spoken
    elif isinstance(value, np.ndarray | list) and len(value) <= LONGEST:
        for i, item in enumerate(value):
            called = f".{labels[i]}" if len(labels) == len(value) else f"[{i}]"
            yield from _numbers(item, (*path, i), (), spoken + called)
    elif hasattr(value, "__msgtype__"):
        labels = _labels(value)
        for name in value.__dataclass_fields__:
            if name not in ("header", "__msgtype__"):
                inner = f"{spoken}.{name}" if spoken else name
                yield from _numbers(getattr(value, name), (*path, name), labels, inner)


def _labels(message: Any) -> tuple[str, ...]:
    """The names of a message such as JointState."""
    names = getattr(message, "name", None)
    return tuple(map(str, names)) if isinstance(names, list | np.ndarray) else ()


def _at(message: Any, path: Path_) -> float:
    """A number of a message; NaN where an array is shorter."""
    for step in path:
        if isinstance(step, str):
            message = getattr(message, step)
        elif step < len(message):
            message = message[step]
        else:
            return np.nan
    return float(message)
