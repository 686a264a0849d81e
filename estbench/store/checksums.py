"""Checksums of the small files of a results folder, and JSON files that carry their own."""

import hashlib
import json
import os
from pathlib import Path
from typing import Any

CHECKSUM = "checksum"


def digest(value: Any) -> str:
    """Sixteen hexadecimal digits: the BLAKE2 hash of a text, or of a value's canonical JSON."""
    text = value if isinstance(value, str) else json.dumps(value, sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def write(path: Path, value: Any) -> None:
    """Write a value and its checksum as JSON.

    Raises:
        OSError: the file cannot be written.
    """
    replace(path, json.dumps({"content": value, CHECKSUM: digest(value)}))


def read(path: Path) -> Any:
    """The value that `write` wrote; that of a file of an earlier version, which has no checksum.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is damaged.
    """
    stored = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(stored, dict) or not {"content", CHECKSUM} & stored.keys():
        return stored
    if stored.get(CHECKSUM) != digest(stored.get("content")):
        raise ValueError("its checksum is wrong")
    return stored["content"]


def replace(path: Path, text: str) -> None:
    """Write a text beside its place and move it there: no reader sees a part of it.

    Raises:
        OSError: the file cannot be written.
    """
    draft = path.with_name(f"{path.name}.partial")
    draft.write_text(text, encoding="utf-8")
    os.replace(draft, path)
