"""The page's figures over time, in plotly, and the sections of all figures."""

import hashlib
from typing import Any

import numpy as np

from estbench.consistency.coverage import SIGMAS
from estbench.report.figures import data, palette, residuals, spreads
from estbench.report.figures.data import thin
from estbench.report.figures.drawing import (
    BAND,
    Drawing,
    Material,
    area,
    axes,
    drawing,
    event_marks,
    line,
    span,
    with_marks,
)


def drawings(material: Material) -> dict[str, list[Drawing]]:
    """All figures by section of the page; those of traces only if there are any."""
    n = range(len(material.names))
    out = {
        "verdict": [spreads.verdict(material)],
        "consistency": [
            *([_steps(material, "nees")] if material.truth else []),
            _steps(material, "nis"),
        ],
        "innovations": residuals.drawings(material),
        "rmse": [_rmse(material, i) for i in n] if material.truth else [],
        "cost": [spreads.cost(material)],
        "error": [],
        "coverage": [],
        "density": [],
        "correlation": spreads.innovations(material),
    }
    if any(material.coverage):
        out["coverage"] = [spreads.coverage(material, k) for k in range(len(SIGMAS))]
    if any(material.traces) and material.truth:
        out["error"] = [_run_nees(material), *(_error(material, i) for i in n)]
        out["density"] = [
            spreads.nees_density(material),
            *(spreads.error_density(material, i) for i in n),
        ]
    if any(material.traces):
        out["correlation"].append(spreads.correlation(material))
    return out


def _steps(material: Material, what: str) -> Drawing:
    curves = material.nees if what == "nees" else material.nis
    label = "NEES/n" if what == "nees" else "NIS/m"
    traces: list[Any] = []
    for i, (entry, steps) in enumerate(zip(material.entries, curves)):
        keep = thin(np.stack([steps.mean, steps.low], axis=1), data.POINTS)
        x, low, high = steps.time[keep], steps.low[keep], steps.high[keep]
        same = hashlib.sha1(x.tobytes() + low.tobytes() + high.tobytes()).hexdigest()[:12]
        traces += area(x, low, high, BAND, {"entry": entry.key, "band": same})
        traces.append(
            line(i, x, steps.mean[keep], entry.key, meta={"entry": entry.key, "role": "mean"})
        )
    level = material.entries[0].source.level
    layout = axes("time (s)", f"mean {label}", **span([s.mean for s in curves]))
    return drawing(
        what, f"{label} averaged over the runs, with the {level:.0%} band", traces, layout, 300,
        time=True,
    )  # fmt: skip


def _rmse(material: Material, i: int) -> Drawing:
    traces: list[Any] = []
    for k, (entry, curve) in enumerate(zip(material.entries, material.rmse)):
        keep = thin(curve.rmse[:, i], data.POINTS // 2)
        x, meta = curve.time[keep], {"entry": entry.key}
        low, high = curve.low[keep, i], curve.high[keep, i]
        traces += area(x, low, high, palette.faint(k, 0.2), meta)
        traces += [
            line(k, x, curve.rmse[keep, i], f"{entry.key} RMSE", meta=meta | {"role": "rmse"}),
            line(
                k, x, curve.sigma[keep, i], f"{entry.key} σ", meta=meta | {"role": "sigma"},
                line={"dash": "dot", "width": 1.4},
            ),
        ]  # fmt: skip
    name, unit = material.names[i], material.units[i]
    layout = axes("time (s)", unit, **span([c.rmse[:, i] for c in material.rmse]))
    return drawing(f"rmse-{i}", name, traces, layout, 230, time=True, coordinate=i)


def _error(material: Material, i: int) -> Drawing:
    """Error of the selected run; the page's script sets x and y."""
    traces: list[Any] = []
    for k, entry in enumerate(material.entries):
        for sigmas, alpha in ((3, 0.12), (1, 0.2)):
            low, high = area([], [], [], palette.faint(k, alpha), {"entry": entry.key})
            for side, scale in ((low, -sigmas), (high, sigmas)):
                bind = {"field": "std", "row": i, "scale": scale}
                side.update(meta={"entry": entry.key, "bind": bind})
            traces += [low, high]
        bind = {"field": "error", "row": i, "scale": 1}
        meta = {"entry": entry.key, "bind": bind, "role": "error"}
        traces.append(line(k, [], [], entry.key, meta=meta, line={"width": 1.3}))
    traces += event_marks(material.entries)
    layout = with_marks(axes("time (s)", material.units[i], zeroline=True))
    return drawing(
        f"error-{i}", material.names[i], traces, layout, 230, time=True, coordinate=i, trim=True
    )


def _run_nees(material: Material) -> Drawing:
    source = material.entries[0].source
    low, high = data.chi_square_band(source.n, 1, source.level)
    ends = [float(source.times[0]), max(float(e.source.times[-1]) for e in material.entries)]
    traces: list[Any] = area(
        ends, [low / source.n] * 2, [high / source.n] * 2, BAND, {"band": "run"}
    )
    for k, entry in enumerate(material.entries):
        bind = {"field": "nees", "row": 0, "scale": 1}
        meta = {"entry": entry.key, "bind": bind, "role": "nees"}
        traces.append(line(k, [], [], entry.key, meta=meta, line={"width": 1.3}))
    traces += event_marks(material.entries)
    layout = with_marks(axes("time (s)", "NEES/n of the run", type="log"))
    title = f"NEES/n of the run, with the {source.level:.0%} band of a single run"
    return drawing("run-nees", title, traces, layout, 230, time=True, trim=True)
