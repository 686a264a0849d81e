"""An empty store: every array is declared, with one chunk per batch and a checksum per chunk."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import zarr
from zarr.codecs import Crc32cCodec

from estbench.consistency.fields import PHASES, Field
from estbench.consistency.records import SIZES, SUMMARY, TRUTH, fields
from estbench.experiment.long import sampled, sampled_times
from estbench.experiment.prepared import Setup
from estbench.inference.innovations import readings
from estbench.robots.layout import state_names
from estbench.scenario.schema import Scenario
from estbench.store import versions
from estbench.store.metadata import Labels, write_labels

DONE = Field(("run",), "?", "the run is complete; ignore the others")


def live(setup: Setup) -> bool:
    """Whether the controller sees the estimate, so that each estimator has a truth of its own."""
    return setup.scenario.control.observe == "estimate"


def labels(setup: Setup, keep: str) -> Labels:
    """The names of rows and columns of a store.

    Args:
        setup: the experiment.
        keep: `summary`, `diagonal`, `full` or `log`.
    """
    space, seen = setup.space, readings(setup.channel_spaces)
    texts = {
        "coordinate": ("coordinate", space.names),
        "coordinate_": ("coordinate_", space.names),
        "unit": ("coordinate", space.units),
        "phase": ("phase", PHASES),
        "channel": ("channel", tuple(setup.channel_spaces)),
    }
    if keep != "summary":
        texts["state"] = ("state", state_names(space))
    if keep in ("full", "log"):
        texts |= {"reading": ("reading", seen), "reading_": ("reading_", seen)}
    return {
        "run": ("run", np.arange(setup.scenario.simulation.runs)),
        "time": ("time", sampled_times(setup, keep)),
        **{name: (dim, np.array(values, dtype=object)) for name, (dim, values) in texts.items()},
    }


def declare(
    root: zarr.Group,
    setup: Setup,
    keep: str,
    batches: Sequence[range],
    dtype: str,
    more: Mapping[str, Any],
) -> None:
    """Declare every array of a store.

    Args:
        root: an empty group.
        setup: the experiment.
        keep: `summary`, `diagonal`, `full` or `log`.
        batches: the runs of each batch; all but the last have the same length.
        dtype: of the traces, `float64` or `float32`; averages are always float64.
        more: attributes.
    """
    sizes = {**lengths(setup, keep), "batch": len(batches)}
    chunk = {**sizes, "run": len(batches[0]), "batch": 1}
    root.attrs.update(
        {
            **provenance(setup.scenario), "versions": versions.stamped(), "keep": keep,
            "batch_size": len(batches[0]), "dtype": dtype, "instants": len(setup.instants),
            **more,
        }
    )  # fmt: skip
    write_labels(root, labels(setup, keep))
    root["time"].attrs["units"] = "s"

    def group(path: str, table: Mapping[str, Field], kind: str | None = None) -> None:
        for name, field in table.items():
            root.create_array(
                f"{path}/{name}".strip("/"),
                shape=tuple(sizes[d] for d in field.dims),
                chunks=tuple(chunk[d] for d in field.dims),
                dtype=kind if kind and field.dtype == "f8" else field.dtype,
                dimension_names=field.dims,
                fill_value=np.nan if field.dtype.startswith("f") else 0,
                compressors=Crc32cCodec(),  # noise does not compress; corruption must not pass
                attributes={"meaning": field.meaning},
            )

    group("", {"done": DONE})
    traces = {k: v for k, v in fields(keep, live(setup)).items() if k not in SUMMARY}
    for label in setup.scenario.estimators:
        group(label, SUMMARY)
        group(label, traces, dtype)
    if keep != "summary" and not live(setup):
        group("truth", TRUTH, dtype)


def lengths(setup: Setup, keep: str) -> dict[str, int]:
    """The length of every dimension of a store but `batch`.

    Args:
        setup: the experiment.
        keep: `summary`, `diagonal`, `full` or `log`.
    """
    space, seen = setup.space, readings(setup.channel_spaces)
    return {
        "run": setup.scenario.simulation.runs,
        "time": len(sampled(setup, keep)),
        "channel": len(setup.channel_spaces),
        "coordinate": space.n,
        "coordinate_": space.n,
        "state": space.nx,
        "reading": len(seen),
        "reading_": len(seen),
        **SIZES,
    }


def provenance(scenario: Scenario) -> dict[str, Any]:
    """Attributes of a store: scenario, seed, installed versions, estimators."""
    return {
        "scenario": scenario.name,
        "seed": scenario.simulation.seed,
        "versions": versions.installed(),
        "estimators": list(scenario.estimators),
    }
