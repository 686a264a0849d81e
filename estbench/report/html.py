"""`estbench report`: one self-contained HTML file that opens offline."""

import base64
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import estbench
from estbench.consistency import statistics
from estbench.consistency.statistics import LAG_ONE
from estbench.errors import EstbenchError, MissingExtraError, StoreError
from estbench.inference.lags import LAGS
from estbench.report import budgets, contact, facts, pictures, tables
from estbench.report.figures import data, palette, shares, traces
from estbench.report.figures.drawing import Drawing, Material
from estbench.report.figures.figures import drawings
from estbench.report.sources import Entry, load
from estbench.tables.cells import lost_note
from estbench.tables.destination import check_file

try:
    import jinja2
    from plotly.io.json import to_json_plotly
    from plotly.offline import get_plotlyjs
except ImportError:
    raise MissingExtraError("plotly or jinja2", "report") from None

SHOWN_ENTRIES, SHOWN_COORDINATES = 4, 8
"""How many entries and coordinates are drawn at first."""
NAMED = 6
"""Most estimators in the page's title."""
SECTIONS = (
    ("verdicts", "Verdicts"), ("scenario", "Scenario"), ("comparison", "Comparison"),
    ("error", "Error"), ("innovations", "Innovations"), ("consistency", "Consistency"),
    ("rmse", "RMSE"), ("coverage", "Coverage"), ("correlation", "Autocorrelation"),
    ("budget", "Error budget"), ("diverged", "Diverged"), ("cost", "Cost"),
)  # fmt: skip
OPTIONAL = ("error", "innovations", "rmse", "coverage", "correlation", "budget")
"""Sections that are there only with their figures."""
Say = Callable[[str], None]


def write_report(
    folders: Sequence[str | Path],
    out: str | Path | None = None,
    estimators: Sequence[str] = (),
    video: bool = True,
    say: Say = lambda line: None,
    budget: bool = False,
) -> Path:
    """Write the report of results folders.

    Args:
        folders: written by `estbench run`, all of one robot.
        out: the file; default `report.html` in the first folder.
        estimators: labels to show; default all.
        video: whether to embed clips of the best and of the worst run, if they can be drawn.
        say: called with a line about each slow part.
        budget: whether to compute the error budget of each estimator, some seconds each.

    Returns:
        The file.

    Raises:
        StoreError: a folder cannot be read, or the file cannot be written.
    """
    if out is not None:
        check_file(Path(out))
    entries = load(folders, estimators)
    path = Path(out) if out is not None else Path(folders[0]) / "report.html"
    page = render(entries, video, say, budget)
    try:
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise StoreError(f"{path} cannot be written: {error.strerror}; choose --out") from None
    return path


def render(
    entries: Sequence[Entry],
    video: bool = True,
    say: Say = lambda line: None,
    budget: bool = False,
) -> str:
    """The page as text."""
    of_traces = []
    for entry in entries:
        say(f"reading {entry.key}")
        of_traces.append(traces.statistics(entry))
    material = Material(entries, of_traces)
    figures = drawings(material)
    of_sources = budgets.budgets(entries, say) if budget else []
    figures["budget"] = shares.drawings(of_sources)
    has_traces = any(of_traces)
    runs, points = traces.run_points(entries)
    chosen = data.choose_runs(entries, runs) if has_traces else []
    clips, problem = pictures.clips(entries, say) if video and has_traces else ([], "")
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=False
    )
    text = resources.files("estbench.report").joinpath
    template = environment.from_string(text("template.html.j2").read_text("utf-8"))
    first = entries[0].source
    shown_run = _worst(entries[0], chosen)
    events = _events(entries, chosen, say)
    packed = _data(material, figures, chosen, points, shown_run, events)
    sources = list({id(e.source): e.source for e in entries}.values())
    robots = [pictures.picture(source, say) for source in sources]
    steps = max(len(source.times) for source in sources)
    summaries = [entry.summary for entry in entries]
    shown = statistics.shown("report", summaries=summaries)
    each = statistics.shown("report", "coordinate", summaries)
    return template.render(
        title=", ".join(dict.fromkeys(s.scenario.name for s in sources))
        + (f": {', '.join(e.key for e in entries)}" if len(entries) <= NAMED
           else f": {len(entries)} estimators"),
        created=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        version=estbench.__version__,
        notices=tables.notices(entries, of_traces),
        sections=[s for s in SECTIONS if s[0] not in OPTIONAL or figures[s[0]]
                  or (s[0] == "budget" and of_sources)],
        budgets=of_sources,
        entries=[tables.entry(material, i) for i in range(len(entries))],
        rmse=tables.rmse(entries),
        headings=[s.heading_in("report") for s in shown],
        more_headings=[s.heading for s in each[1:]],
        ideals=statistics.ideals("report", summaries),
        across="runs" if all(s.log is None for s in sources) else "runs, or parts of a log",
        rmse_notes=[*(s.note for s in each if s.note), *lost_note([e.summary for e in entries])],
        lag_one=LAG_ONE.heading,
        phases=tables.by_phase(entries),
        baselines=tables.baselines(entries) if len(entries) > 1 else [],
        names=first.names,
        many=len(entries) > max(3, len(first.names)),
        units=first.units,
        level=f"{first.level:.0%}",
        chance=f"{1 - first.level:.0%}",
        burn_in=f"{first.scenario.consistency.burn_in:g}" if first.scenario.consistency.burn_in
        else "",
        facts=[vars(facts.facts(s)) | {"picture": p}
               for s, p in zip(sources, robots)],
        drawings=figures,
        runs=chosen,
        shown_run=shown_run,
        thinned=points < steps,
        events=[(kind, sign) for kind, (_, _, sign) in palette.EVENTS.items()
                if any(kind in run for of_runs in events for run in of_runs.values())],
        exact=has_traces,
        truth=material.truth,
        clips=clips,
        no_clips=problem,
        outside=tables.outside(entries, of_traces),
        white=tables.white(material),
        lags=LAGS,
        diverged=facts.diverged(entries, of_traces),
        drawn=f"Statistics are over every run; {len(chosen)} runs are drawn." if chosen else "",
        css=_raw(text("page.css").read_text("utf-8")),
        js=_raw(text("page.js").read_text("utf-8")),
        plotly=_raw(get_plotlyjs()),
        data=_raw(packed),
    )  # fmt: skip


def _raw(text: str) -> Any:
    """Text for a script or style element, unescaped; nothing in it may close the element."""
    from markupsafe import Markup

    return Markup(text.replace("</script", "<\\/script").replace("</style", "<\\/style"))


def _worst(entry: Entry, chosen: Sequence[data.Chosen]) -> str:
    """The run shown first: the worst one of the first entry."""
    if not chosen:
        return ""
    anees = np.where(np.isfinite(entry.record["anees"]), entry.record["anees"], np.inf)
    rank = {int(run): value for run, value in zip(entry.source.runs, anees)}
    return str(max((c.run for c in chosen), key=lambda run: rank.get(run, -1.0)))


def _events(
    entries: Sequence[Entry], chosen: Sequence[data.Chosen], say: Say
) -> Sequence[Mapping[int, contact.Events]]:
    """The events of contact of the chosen runs, of each entry by run."""
    try:
        return contact.events_of_entries(entries, [c.run for c in chosen])
    except EstbenchError as error:
        say(f"no marks of contact: {error}")
        return [{} for _ in entries]


def _data(
    material: Material,
    figures: dict[str, list[Drawing]],
    chosen: Sequence[data.Chosen],
    points: int,
    shown_run: str,
    events: Sequence[Mapping[int, contact.Events]],
) -> str:
    """The data for the page's script, as JSON."""
    runs: dict[str, dict[str, Any]] = {}
    for choice in chosen:
        runs[str(choice.run)] = {}
        for entry, of_runs in zip(material.entries, events):
            trace = traces.run_trace(entry, choice.run, points)
            if trace is not None:
                runs[str(choice.run)][entry.key] = {
                    "time": _pack(trace.time[None]),
                    "error": _pack(trace.error),
                    "std": _pack(trace.std),
                    "nees": _pack(trace.nees[None]),
                    "events": {
                        kind: _pack(times[None])
                        for kind, times in of_runs.get(choice.run, {}).items()
                    },
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
                "bound": any({"bind", "event"} & (t.get("meta") or {}).keys() for t in d.traces),
            }
            for section in figures.values() for d in section
        },
        "runs": runs,
    }  # fmt: skip
    return str(to_json_plotly(packed)).replace("</", "<\\/")


def _pack(values: NDArray) -> dict[str, Any]:
    """Rows as little-endian single precision in base64."""
    raw = np.ascontiguousarray(values, "<f4").tobytes()
    return {"dtype": "f4", "bdata": base64.b64encode(raw).decode(), "shape": list(values.shape)}
