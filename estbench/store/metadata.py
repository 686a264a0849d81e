"""The metadata of a store, checked when it is read and restored when it is resumed.

`data.zarr/zarr.json` holds the attributes and the metadata of every array. It has a checksum, and
`metadata.json` beside the store is a copy: whichever is intact restores the other, and the files
`zarr.json` of the arrays. The attribute `integrity` has this checksum, those of the texts beside
the store, and the names of the labels. Texts and labels are written again from the scenario that
the user names. A store of an earlier version has no `integrity` and is not checked.
"""

import json
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import Crc32cCodec

from estbench.errors import StoreError
from estbench.store import checksums, locks
from estbench.store.checksums import CHECKSUM

STORE, COPY, INTEGRITY = "data.zarr", "metadata.json", "integrity"

Labels = Mapping[str, tuple[str, NDArray[Any]]]
"""Name of an array -> its dimension and its values."""

UNREADABLE = (OSError, ValueError, KeyError, RuntimeError)
"""What zarr raises for a chunk that is damaged."""


def opened(root: zarr.Group, path: str) -> Any:
    """An array of which every chunk is written, even if all its values are the fill value.

    zarr's own setting is one of the process: threads that set and restore it disturb each other.
    """
    array: Any = root[path]
    return array.with_config({"write_empty_chunks": True})


def write_labels(root: zarr.Group, labels: Labels) -> None:
    """Declare and write the arrays that name rows and columns, one chunk each."""
    for name, (dim, values) in labels.items():
        # Strings of variable length: the only ones that zarr 3 has a specification for.
        root.create_array(
            name, shape=values.shape, dimension_names=(dim,), compressors=Crc32cCodec(),
            dtype=str if values.dtype == object else values.dtype,  # type: ignore[arg-type]
        )  # fmt: skip
        opened(root, name)[:] = values


def seal(folder: Path, texts: Mapping[str, str], labels: Labels) -> None:
    """Put the metadata of all arrays into one file, with its checksum and its copy.

    Args:
        folder: of the results; all arrays are declared.
        texts: name of a file beside the store -> what it holds.
        labels: that the store has.

    Raises:
        OSError: the folder cannot be written.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # zarr: not yet in the standard
        zarr.consolidate_metadata(str(folder / STORE))
    files = {name: checksums.digest(text) for name, text in texts.items()}
    change(folder, **{INTEGRITY: {"files": files, "labels": list(labels)}})


def change(folder: Path, **attributes: Any) -> None:
    """Set attributes of a store, and its checksum if it has one.

    Raises:
        OSError: the folder cannot be written.
    """
    root = folder / STORE / "zarr.json"
    stored = json.loads(root.read_text(encoding="utf-8"))
    stored["attributes"] |= attributes
    if INTEGRITY not in stored["attributes"]:
        checksums.replace(root, json.dumps(stored, indent=2))
        return
    _put(folder, stored)


def _put(folder: Path, stored: dict[str, Any]) -> None:
    """Write the metadata and its copy, with their checksum."""
    stored["attributes"][INTEGRITY][CHECKSUM] = _digest(stored)
    for path in (folder / STORE / "zarr.json", folder / COPY):
        checksums.replace(path, json.dumps(stored, indent=2))


def lengthen(
    folder: Path, texts: Mapping[str, str], labels: Labels, lengths: Mapping[str, int]
) -> None:
    """Declare every array longer along some dimensions; no chunk is written.

    The metadata comes first, with the checksums of the new texts. If the process is killed then,
    `restore` and `restore_labels` write the rest.

    Args:
        folder: of the results; nobody else writes to it.
        texts: name of a file beside the store -> what it is to hold.
        labels: that name the rows of the longer store, each one chunk.
        lengths: dimension -> its new length.

    Raises:
        StoreError: the metadata is damaged, or of an earlier version without checksums.
        OSError: the folder cannot be written.
    """
    with locks.briefly(folder):
        stored = _intact(folder / STORE / "zarr.json")
        if stored is None:
            raise StoreError(
                f"{folder} was begun with an earlier version of estbench: it takes no more runs; "
                "choose another --out"
            )
        for name, node in stored["consolidated_metadata"]["metadata"].items():
            for axis, dim in enumerate(node.get("dimension_names") or ()):
                if dim in lengths:
                    node["shape"][axis] = lengths[dim]
                    if name in labels:
                        node["chunk_grid"]["configuration"]["chunk_shape"][axis] = lengths[dim]
        digests = {name: checksums.digest(text) for name, text in texts.items()}
        stored["attributes"][INTEGRITY]["files"] |= digests
        _put(folder, stored)
        _restore(folder, texts)


def holds(folder: Path, texts: Mapping[str, str]) -> bool:
    """Whether the files beside the store hold these texts."""
    return all(_checksum(folder / name) == checksums.digest(x) for name, x in texts.items())


def rows(folder: Path, name: str) -> int | None:
    """Length of a chunk along the last dimension of an array; None if the metadata is damaged."""
    paths = folder / STORE / "zarr.json", folder / COPY
    stored = next(filter(None, map(_intact, paths)), None)
    if stored is None:
        return None
    node = stored["consolidated_metadata"]["metadata"][name]
    return int(node["chunk_grid"]["configuration"]["chunk_shape"][-1])


def is_sealed(folder: Path) -> bool:
    """Whether the store has checksums; one of an earlier version has none."""
    root = _json(folder / STORE / "zarr.json")
    own = root.get("attributes") if isinstance(root, dict) else None
    return (isinstance(own, dict) and INTEGRITY in own) or (folder / COPY).is_file()


def check(folder: Path) -> None:
    """Check the metadata, the labels and the files beside the store.

    Raises:
        StoreError: one of them is damaged; its file is named.
    """
    if not is_sealed(folder):
        return
    stored = _intact(folder / STORE / "zarr.json")
    if stored is None:
        raise _damaged(folder / STORE / "zarr.json")
    integrity = stored["attributes"][INTEGRITY]
    for name, checksum in integrity["files"].items():
        if _checksum(folder / name) != checksum:
            raise _damaged(folder / name)
    root = zarr.open_group(str(folder / STORE), mode="r", zarr_format=3)
    for name in integrity["labels"]:
        if _label(folder, root, name) is None:
            raise _damaged(folder / STORE / name)


def restore(folder: Path, texts: Mapping[str, str]) -> list[str]:
    """Write again what is damaged of the metadata and of the files beside the store.

    Args:
        folder: of the results.
        texts: name of a file beside the store -> what it holds, as the user's scenario gives it.

    Returns:
        The names of the files that were written again.

    Raises:
        StoreError: a file is damaged and nothing can restore it.
        OSError: the folder cannot be written.
    """
    if not is_sealed(folder):
        return []
    with locks.briefly(folder):  # what another process changes is read before or after
        return _restore(folder, texts)


def _restore(folder: Path, texts: Mapping[str, str]) -> list[str]:
    paths = folder / STORE / "zarr.json", folder / COPY
    found = [_intact(path) for path in paths]
    stored = found[0] or found[1]
    if stored is None:
        raise StoreError(f"{paths[0]} and {paths[1]} are damaged; choose another --out")
    again: dict[Path, str] = {}
    for path, intact in zip(paths, found):
        if intact != stored:
            again[path] = json.dumps(stored, indent=2)
    for name, node in stored["consolidated_metadata"]["metadata"].items():
        path = folder / STORE / name / "zarr.json"
        own = {k: v for k, v in node.items() if k != "consolidated_metadata"}
        if _json(path) != own:
            again[path] = json.dumps(own, indent=2)
    for name, checksum in stored["attributes"][INTEGRITY]["files"].items():
        if _checksum(folder / name) == checksum:
            continue
        if checksums.digest(texts[name]) != checksum:
            raise StoreError(
                f"{folder / name} is damaged: its checksum is wrong; resume with the scenario that "
                "the store was begun with, which writes it again, or choose another --out"
            )
        again[folder / name] = texts[name]
    for path, text in again.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        checksums.replace(path, text)
    return [path.relative_to(folder).as_posix() for path in again]


def restore_labels(folder: Path, root: zarr.Group, labels: Labels) -> list[str]:
    """Write the labels again that cannot be read or are not those of the scenario.

    Args:
        folder: of the results.
        root: the store, open for writing.
        labels: as `write_labels` takes them; one that the store lacks is left out.

    Returns:
        The names of the arrays that were written again.
    """
    wrong = [
        name
        for name, (_, values) in labels.items()
        if name in root
        and ((found := _label(folder, root, name)) is None or not np.array_equal(found, values))
    ]
    for name in wrong:
        opened(root, name)[:] = labels[name][1]
    return [f"{STORE}/{name}" for name in wrong]


def _label(folder: Path, root: zarr.Group, name: str) -> NDArray[Any] | None:
    """The values of a label; None where it is damaged or its chunk is missing."""
    if is_sealed(folder) and not (folder / STORE / name / "c" / "0").is_file():
        return None
    try:
        return np.asarray(root[name][:])  # type: ignore[index]
    except UNREADABLE:
        return None


def _digest(stored: dict[str, Any]) -> str:
    """The checksum of the metadata without the checksum in it."""
    attributes = stored["attributes"]
    bare = {k: v for k, v in attributes[INTEGRITY].items() if k != CHECKSUM}
    return checksums.digest({**stored, "attributes": {**attributes, INTEGRITY: bare}})


def _intact(path: Path) -> dict[str, Any] | None:
    """The metadata in a file; None where it is missing or damaged."""
    stored = _json(path)
    try:
        whole = stored["attributes"][INTEGRITY][CHECKSUM] == _digest(stored)
    except (AttributeError, KeyError, TypeError):
        return None
    return stored if whole else None


def _json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def _checksum(path: Path) -> str | None:
    try:
        return checksums.digest(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def _damaged(path: Path) -> StoreError:
    return StoreError(
        f"{path} is damaged or missing: its checksum is wrong; go on with --resume, which writes "
        "it again"
    )
