"""The innovations of logs over time, with the σ that the filter expects of them."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from estbench.errors import EstbenchError
from estbench.experiment import setup
from estbench.inference.innovations import readings
from estbench.report.figures import data, palette
from estbench.report.figures.data import thin
from estbench.report.figures.drawing import Drawing, Material, area, axes, drawing, line
from estbench.report.sources import Entry, read
from estbench.shapes import Array


@dataclass(frozen=True, eq=False)
class Residual:
    """One component of the innovations of one run, where it arrived, thinned.

    Attributes:
        name: of the component.
        unit: its unit; empty where the robot's file is missing.
        time: s `(k,)`.
        value: ν `(k,)`.
        std: √ of its variance in S `(k,)`.
    """

    name: str
    unit: str
    time: Array
    value: Array
    std: Array


def residuals(entry: Entry, run: int = 0, points: int = data.POINTS) -> list[Residual]:
    """The components of the innovations that were fused; [] if the store does not have them."""
    group = entry.group
    if "innovation" not in group:
        return []
    group = group.isel(run=run)
    value = group["innovation"].values
    units = _units(entry)
    std = np.sqrt(np.diagonal(group["innovation_cov"].values, axis1=-2, axis2=-1))
    out = []
    for i, name in enumerate(map(str, read(entry.source.tree, "reading"))):
        came = np.flatnonzero(np.isfinite(value[:, i]) & np.isfinite(std[:, i]))
        if len(came):
            came = came[thin(np.abs(value[came, i]) / std[came, i], points)]
            out.append(
                Residual(
                    name, units.get(name, ""), entry.source.times[came], value[came, i],
                    std[came, i],
                )
            )  # fmt: skip
    return out


def _units(entry: Entry) -> dict[str, str]:
    """Component of a reading -> unit."""
    try:
        spaces = setup.build(entry.source.scenario).channel_spaces
    except EstbenchError:
        return {}
    units = [unit for space in spaces.values() for unit in space.units]
    return dict(zip(readings(spaces), units))


def drawings(material: Material) -> list[Drawing]:
    """One figure for each component of the readings of logs."""
    of_logs = [
        (k, entry, {r.name: r for r in residuals(entry)})
        for k, entry in enumerate(material.entries)
        if entry.source.log is not None
    ]
    names = dict.fromkeys(name for *_, found in of_logs for name in found)
    out = []
    for i, name in enumerate(names):
        traces: list[Any] = []
        for k, entry, found in of_logs:
            if name not in found:
                continue
            r, meta = found[name], {"entry": entry.key}
            for sigmas, alpha in ((3, 0.12), (1, 0.2)):
                traces += area(
                    r.time, -sigmas * r.std, sigmas * r.std, palette.faint(k, alpha), meta
                )
            traces.append(line(k, r.time, r.value, entry.key, meta=meta, line={"width": 1.0}))
        unit = next(found[name].unit for *_, found in of_logs if name in found)
        layout = axes("time (s)", unit, zeroline=True)
        out.append(drawing(f"innovation-{i}", name, traces, layout, 230, time=True))
    return out
