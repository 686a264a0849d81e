"""A replay as a results folder: one run in the store of `estbench run`, and where it is from."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from estbench.logs.outcome import Replay
from estbench.logs.trajectory import write_tum
from estbench.store.checksums import digest
from estbench.store.zarr import Store

TRAJECTORIES = "trajectories"


def write(found: Replay, folder: Path) -> Replay:
    """Write a replay, completely or not at all.

    Besides the store, the poses of moving bases are written as TUM files where the truth has them.

    Args:
        found: the replay.
        folder: must not exist.

    Raises:
        StoreError: the folder exists or cannot be written.
    """
    made = Store.create(folder, found.prepared, "log", 1, more={"log": provenance(found)})
    try:
        with made.lock():
            x = found.replayed[0].traces.truth[:, 0][None]
            made.write(0, {"x": x}, {r.label: r.record for r in found.replayed})
        trajectories(found, folder / TRAJECTORIES)
    except BaseException:
        made.discard()
        raise
    return replace(found, folder=folder)


def provenance(found: Replay) -> dict[str, Any]:
    """What a store says of its log: files, contents, channels that are not fused, truth."""
    parts = found.log.channels
    return {
        "files": list(dict.fromkeys(part.table.path.name for part in parts)),
        "content": digest([[p.name, digest(np.column_stack([p.taken, p.y]).tobytes().hex())]
                           for p in parts]),
        "held_out": [name for name in found.prepared.channel_spaces if name not in found.fused],
        "truth": found.log.truth is not None,
    }  # fmt: skip


def trajectories(found: Replay, folder: Path) -> None:
    """Write TUM files of each estimator: `JOINT.LABEL.tum` and `JOINT.LABEL.truth.tum`.

    The truth is at the same times, in the frame of the model; a fitted frame is that of the
    estimator.
    """
    for r in found.replayed:
        for name, (estimate, reference) in r.poses.items():
            folder.mkdir(exist_ok=True)
            write_tum(folder / f"{name}.{r.label}.tum", estimate)
            write_tum(folder / f"{name}.{r.label}.truth.tum", reference)
