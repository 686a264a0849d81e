"""Pictures in the page: the robot, and clips of the best and of the worst run."""

import base64
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from estbench.analysis.stored import Stored
from estbench.errors import EstbenchError
from estbench.experiment import setup
from estbench.report.rendering import render, replay
from estbench.report.sources import Entry

Say = Callable[[str], None]
CLIP_SECONDS, CLIP_FPS, CLIP_WIDTH = 5.0, 12.0, 320


def picture(source: Stored, say: Say) -> str:
    """The robot at its initial estimate as a data URI, or "" if it cannot be drawn."""
    try:
        prepared = setup.build(source.scenario)
        with render.Renderer(prepared.plant.model, 480, 360) as renderer:
            pixels = renderer.draw(prepared.mean)
    except EstbenchError as error:
        say(f"no picture of the robot: {error}")
        return ""
    return "data:image/png;base64," + base64.b64encode(render.png(pixels)).decode()


def clips(entries: Sequence[Entry], say: Say) -> tuple[list[dict[str, Any]], str]:
    """Short videos of the best and of the worst run, or the reason why there are none."""
    try:
        from estbench.report.rendering import video

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
                    "caption": _caption(what, entry, run)
                    + (f", {speed:.3g} times as fast." if speed > 1 else "."),
                }
            )
    except EstbenchError as error:
        return [], f"There are no videos: {error}"
    return out, ""


def _caption(what: str, entry: Entry, run: int) -> str:
    if entry.source.log:
        return f"{entry.key} on the log"
    return f"The {what} run by NEES: run {run} of {entry.key}"


def _extremes(entries: Sequence[Entry]) -> list[tuple[str, Entry, int]]:
    """The runs with the least and the greatest time-averaged NEES/n of all entries with traces."""
    found = []
    if all(entry.source.log for entry in entries):
        return [("log", entries[0], 0)]
    for entry in entries:
        if entry.source.has_traces:
            anees = np.where(np.isfinite(entry.record["anees"]), entry.record["anees"], np.inf)
            for place in (anees.argmin(), anees.argmax()):
                found.append((float(anees[place]), entry, int(entry.source.runs[place])))
    best, worst = (pick(found, key=lambda f: f[0]) for pick in (min, max))
    return [("best", *best[1:]), ("worst", *worst[1:])]
