"""`estbench report`: one self-contained HTML file that opens offline."""

import base64
import math
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import estbench
from estbench.consistency import Interval
from estbench.errors import EstbenchError, MissingExtraError, StoreError
from estbench.report import data, facts, palette, traces
from estbench.report.figures import Drawing, Material, drawings
from estbench.report.sources import Entry, load

try:
    import jinja2
    from plotly.io.json import to_json_plotly
    from plotly.offline import get_plotlyjs
except ImportError:
    raise MissingExtraError("plotly or jinja2", "report") from None

SHOWN_ENTRIES, SHOWN_COORDINATES = 4, 8
"""How many are drawn before the reader chooses."""
SECTIONS = (
    ("verdicts", "Verdicts"), ("scenario", "Scenario"), ("comparison", "Comparison"),
    ("error", "Error"), ("consistency", "Consistency"), ("rmse", "RMSE"),
    ("coverage", "Coverage"), ("correlation", "Autocorrelation"), ("diverged", "Diverged"),
    ("cost", "Cost"),
)  # fmt: skip
CLIP_SECONDS, CLIP_FPS, CLIP_WIDTH = 5.0, 12.0, 320
RELEVANT = 0.01
"""A difference below this part of the baseline's value is not coloured."""
Say = Callable[[str], None]


def write_report(
    folders: Sequence[str | Path],
    out: str | Path | None = None,
    estimators: Sequence[str] = (),
    video: bool = True,
    say: Say = lambda line: None,
) -> Path:
    """Write the report of some results folders.

    Args:
        folders: as `estbench run` wrote them, all of one robot.
        out: the file; default `report.html` in the first folder.
        estimators: labels to take; default all.
        video: whether to embed clips of the best and of the worst run where they can be drawn.
        say: called with a line about each slow part.

    Returns:
        The file.

    Raises:
        StoreError: a folder cannot be read, or the file cannot be written.
    """
    entries = load(folders, estimators)
    path = Path(out) if out is not None else Path(folders[0]) / "report.html"
    page = render(entries, video, say)
    try:
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise StoreError(f"{path} cannot be written: {error.strerror}; choose --out") from None
    return path


def render(entries: Sequence[Entry], video: bool = True, say: Say = lambda line: None) -> str:
    """The page as text."""
    statistics = []
    for entry in entries:
        say(f"reading {entry.key}")
        statistics.append(traces.statistics(entry))
    material = Material(entries, statistics)
    figures = drawings(material)
    has_traces = any(statistics)
    runs, points = traces.run_points(entries)
    chosen = data.choose_runs(entries, runs) if has_traces else []
    clips, problem = _clips(entries, say) if video and has_traces else ([], "")
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=False
    )
    text = resources.files("estbench.report").joinpath
    template = environment.from_string(text("template.html.j2").read_text("utf-8"))
    first = entries[0].source
    shown_run = _worst(entries[0], chosen)
    packed = _data(material, figures, chosen, points, shown_run)
    sources = list({id(e.source): e.source for e in entries}.values())
    pictures = [_picture(source, say) for source in sources]
    steps = max(len(source.times) for source in sources)
    return template.render(
        title=", ".join(dict.fromkeys(s.scenario.name for s in sources))
        + f": {', '.join(e.key for e in entries)}",
        created=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        version=estbench.__version__,
        notices=_notices(entries, statistics),
        sections=[s for s in SECTIONS if s[0] not in ("error", "coverage", "correlation")
                  or has_traces],
        entries=[_entry(material, i) for i in range(len(entries))],
        rmse=_rmse(entries),
        baselines=_baselines(entries) if len(entries) > 1 else [],
        names=first.names,
        units=first.units,
        level=f"{first.level:.0%}",
        burn_in=f"{first.scenario.consistency.burn_in:g}" if first.scenario.consistency.burn_in
        else "",
        facts=[vars(facts.facts(s)) | {"picture": p, "faults": False}
               for s, p in zip(sources, pictures)],
        drawings=figures,
        runs=chosen,
        shown_run=shown_run,
        thinned=points < steps,
        exact=has_traces,
        clips=clips,
        no_clips=problem,
        outside=_outside(entries, statistics),
        lag_one="; ".join(f"{e.key} {facts.show(e.summary.lag_one)}" for e in entries),
        diverged=facts.diverged(entries, statistics),
        drawn=f"Statistics are over every run; {len(chosen)} runs are drawn." if chosen else "",
        css=_raw(text("page.css").read_text("utf-8")),
        js=_raw(text("page.js").read_text("utf-8")),
        plotly=_raw(get_plotlyjs()),
        data=_raw(packed),
    )  # fmt: skip


def _raw(text: str) -> Any:
    """Text that goes into a script or style as it is; nothing in it may close the element."""
    from markupsafe import Markup

    return Markup(text.replace("</script", "<\\/script").replace("</style", "<\\/style"))


def _number(x: float) -> float | None:
    return float(x) if math.isfinite(x) else None


def _cell(value: float, shown: str, kind: str = "") -> dict[str, Any]:
    """A table cell: the number in full for whoever parses the page, and as it is shown."""
    return {"value": repr(float(value)), "shown": shown, "class": kind}


def _entry(material: Material, i: int) -> dict[str, Any]:
    entry = material.entries[i]
    s, nees, nis = entry.summary, material.nees[i], material.nis[i]
    return {
        "key": entry.key,
        "colour": palette.colour(i),
        "dashes": palette.dash(i).replace("px", "").replace("solid", ""),
        "verdict": str(s.verdict),
        "sentence": facts.verdict(entry, nees),
        "cells": [
            _cell(s.anees.value, facts.show(s.anees)),
            _cell(s.anees_median, f"{s.anees_median:.3f}"),
            _cell(s.anis.value, facts.show(s.anis)),
            _cell(s.lag_one.value, facts.show(s.lag_one)),
            _cell(s.diverged, f"{s.diverged:.1%}"),
            _cell(s.cost, f"{s.cost:.3g}"),
            _cell(nees.outside, f"{nees.outside:.1%}"),
            _cell(nis.outside, f"{nis.outside:.1%}"),
        ],
    }


def _rmse(entries: Sequence[Entry]) -> list[dict[str, Any]]:
    source = entries[0].source
    rows = []
    for i, (name, unit) in enumerate(zip(source.names, source.units)):
        cells = []
        for entry in entries:
            s = entry.summary
            cells += [
                _cell(s.rmse[i].value, facts.quantity(s.rmse[i])),
                _cell(s.std[i], f"{s.std[i]:.3g}"),
            ]
        rows.append({"name": name, "unit": unit, "cells": cells})
    return rows


def _baselines(entries: Sequence[Entry]) -> list[dict[str, Any]]:
    """A table for each baseline: rows of a quantity, columns of the other entries."""
    out = []
    names, units = entries[0].source.names, entries[0].source.units
    for baseline in entries:
        b = baseline.summary
        pairs = [data.paired(entry, baseline) for entry in entries if entry is not baseline]
        rows = [
            ("cost", "ratio", [_cell(p.ratio, f"{p.ratio:.3g}") for p in pairs]),
            ("NEES/n", "", [_difference(p.anees, b.anees.value) for p in pairs]),
        ]
        for i, (name, unit) in enumerate(zip(names, units)):
            cells = [_difference(p.rmse[i], b.rmse[i].value) for p in pairs]
            rows.append((name, unit, cells))
        out.append({"key": baseline.key, "pairs": pairs, "rows": rows})
    return out


def _difference(difference: Interval, scale: float) -> dict[str, Any]:
    """A cell; coloured where the difference is neither chance nor too small to matter."""
    kind = _kind(difference, scale)
    mark = {"less": " ▼", "more": " ▲"}.get(kind, "")
    return _cell(difference.value, facts.quantity(difference) + mark, kind)


def _kind(difference: Interval, scale: float) -> str:
    if not abs(difference.value) > RELEVANT * abs(scale):
        return ""
    return "less" if difference.high < 0 else "more" if difference.low > 0 else ""


def _outside(entries: Sequence[Entry], statistics: Sequence[Any]) -> str:
    level = entries[0].source.level
    parts = [
        f"{e.key} NEES {t.outside[0]:.1%}, NIS {t.outside[1]:.1%}"
        for e, t in zip(entries, statistics)
        if t is not None
    ]
    return (
        f"Single values outside the {level:.0%} band of one run ({1 - level:.0%} expected): "
        f"{'; '.join(parts)}."
    )


def _notices(entries: Sequence[Entry], statistics: Sequence[Any]) -> list[str]:
    out = []
    for source in {id(e.source): e.source for e in entries}.values():
        if len(source.runs) < source.total:
            out.append(
                f"{source.title} is unfinished: {len(source.runs)} of {source.total} runs are done."
            )
    bare = [e.source.title for e, t in zip(entries, statistics) if t is None]
    if bare:
        out.append(
            f"{', '.join(dict.fromkeys(bare))} kept no traces: the error of single runs, coverage, "
            "distributions, autocorrelation, videos and the time of divergence need "
            "`estbench run --keep diagonal`."
        )
    return out


def _worst(entry: Entry, chosen: Sequence[data.Chosen]) -> str:
    """The run shown first: the worst of the first entry."""
    if not chosen:
        return ""
    anees = np.where(np.isfinite(entry.record["anees"]), entry.record["anees"], np.inf)
    rank = {int(run): value for run, value in zip(entry.source.runs, anees)}
    return str(max((c.run for c in chosen), key=lambda run: rank.get(run, -1.0)))


def _data(
    material: Material,
    figures: dict[str, list[Drawing]],
    chosen: Sequence[data.Chosen],
    points: int,
    shown_run: str,
) -> str:
    """What the page's script reads, as JSON."""
    runs: dict[str, dict[str, Any]] = {}
    for choice in chosen:
        runs[str(choice.run)] = {}
        for entry in material.entries:
            trace = traces.run_trace(entry, choice.run, points)
            if trace is not None:
                runs[str(choice.run)][entry.key] = {
                    "time": _pack(trace.time[None]),
                    "error": _pack(trace.error),
                    "std": _pack(trace.std),
                    "nees": _pack(trace.nees[None]),
                }
    keys = [entry.key for entry in material.entries]
    packed = {
        "entries": keys,
        "coordinates": list(material.names),
        "span": [
            float(min(e.source.times[0] for e in material.entries)),
            float(max(e.source.times[-1] for e in material.entries)),
        ],
        "shown": {
            "entries": keys[:SHOWN_ENTRIES],
            "coordinates": list(range(min(len(material.names), SHOWN_COORDINATES))),
            "run": shown_run,
        },
        "drawings": {
            d.name: {
                "traces": d.traces, "layout": d.layout, "height": d.height, "time": d.time,
                "coordinate": d.coordinate, "trim": d.trim,
                "bound": any("bind" in (t.get("meta") or {}) for t in d.traces),
            }
            for section in figures.values() for d in section
        },
        "runs": runs,
    }  # fmt: skip
    return to_json_plotly(packed).replace("</", "<\\/")


def _pack(values: NDArray) -> dict[str, Any]:
    """Rows as little-endian single precision in base64."""
    raw = np.ascontiguousarray(values, "<f4").tobytes()
    return {"dtype": "f4", "bdata": base64.b64encode(raw).decode(), "shape": list(values.shape)}


def _picture(source: Any, say: Say) -> str:
    """The robot at its initial estimate as a data URI, or "" where it cannot be drawn."""
    from estbench import setup
    from estbench.report import render

    try:
        prepared = setup.build(source.scenario)
        with render.Renderer(prepared.plant.model, 480, 360) as renderer:
            pixels = renderer.draw(prepared.mean)
    except EstbenchError as error:
        say(f"no picture of the robot: {error}")
        return ""
    return "data:image/png;base64," + base64.b64encode(render.png(pixels)).decode()


def _clips(entries: Sequence[Entry], say: Say) -> tuple[list[dict[str, Any]], str]:
    """Short videos of the best and of the worst run, or a line that says why there are none."""
    from estbench.report import replay

    try:
        from estbench.report import video

        ends = [max(float(e.source.times[-1]) for e in entries)]
        speed = max(1.0, ends[0] / CLIP_SECONDS)
        look = video.Look(CLIP_WIDTH, CLIP_WIDTH * 3 // 4, CLIP_FPS, speed)
        video.check(Path("clip.mp4"), None)
        out = []
        for what, entry, run in _extremes(entries):
            say(f"drawing the {what} run: {run} of {entry.key}")
            content, poster = video.clip(replay.of_entry(entry, run), look)
            out.append(
                {
                    "source": "data:video/mp4;base64," + base64.b64encode(content).decode(),
                    "poster": "data:image/jpeg;base64," + base64.b64encode(poster).decode(),
                    "width": look.width,
                    "speed": repr(speed),
                    "caption": f"The {what} run by NEES: run {run} of {entry.key}"
                    + (f", {speed:.3g} times as fast." if speed > 1 else "."),
                }
            )
    except EstbenchError as error:
        return [], f"There are no videos: {error}"
    return out, ""


def _extremes(entries: Sequence[Entry]) -> list[tuple[str, Entry, int]]:
    """The runs of least and greatest time-averaged NEES/n of all entries with traces."""
    found = []
    for entry in entries:
        if entry.source.has_traces:
            anees = np.where(np.isfinite(entry.record["anees"]), entry.record["anees"], np.inf)
            for place in (anees.argmin(), anees.argmax()):
                found.append((float(anees[place]), entry, int(entry.source.runs[place])))
    best, worst = (pick(found, key=lambda f: f[0]) for pick in (min, max))
    return [("best", *best[1:]), ("worst", *worst[1:])]
