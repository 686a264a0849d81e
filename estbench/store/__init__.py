"""Results on disk: the zarr store, its arrays, its locks and its versions."""

from typing import Any

from zarr.core import group

if not __debug__:  # zarr 3.1 removes a key within an `assert`, which `python -O` leaves out
    _from_dict = group.GroupMetadata.from_dict.__func__  # type: ignore[attr-defined]

    def _without_type(cls: Any, data: dict[str, Any]) -> Any:
        """The metadata of a group from its JSON."""
        return _from_dict(cls, {key: data[key] for key in data if key != "node_type"})

    group.GroupMetadata.from_dict = classmethod(_without_type)  # type: ignore[assignment]
