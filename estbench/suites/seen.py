"""What a suite sees as tables, CSV and JSON."""

import json
from typing import Any

import numpy as np

from estbench.suites.observability import Direction, Observability
from estbench.tables import writers
from estbench.tables.columns import Column, Table
from estbench.tables.quantity import number


def build(found: Observability) -> list[Table]:
    """A table of the coordinates, and one of the directions."""
    since = tuple(_time(t, x) for t, x in zip(found.seen_from, found.left))
    coordinates = Table(
        (Column("coordinate", found.names, "left"), Column("unit", found.units, "left")),
        (
            (Column("σ at the start", tuple(number(s) for s in found.std)),),
            (Column("left of it", tuple(_percent(x) for x in found.left)),),
            (Column("seen from [s]", since),),
        ),
        f"{found.scenario}: what the sensors see in {found.window:g} s",
        "left: of the standard deviation of the state at the start, given all readings and no "
        "process noise; seen: 71% or less is left",
    )  # fmt: skip
    if not found.directions:
        return [coordinates]
    directions = Table(
        (Column("direction", tuple(d.text for d in found.directions), "left", wraps=True),),
        (
            (Column("seen from [s]", tuple("never" if d.seen_from is None else number(d.seen_from)
                                           for d in found.directions)),),
            (Column("left of σ", tuple(_percent(d.left) for d in found.directions)),),
            (Column("a motion that shows it", tuple(_motion(d) for d in found.directions), "left",
                    wraps=True),),
        ),
        "Directions, in units of σ at the start",
        "not seen at the first reading; each is independent of those above it",
    )  # fmt: skip
    return [coordinates, directions]


def to_csv(found: Observability) -> str:
    """One line per direction."""
    return writers.comma_separated(
        ["direction", "seen_from", "left", "shown_by"],
        (
            {"direction": d.text, "seen_from": "" if d.seen_from is None else d.seen_from,
             "left": d.left, "shown_by": "; ".join(name for name, _ in d.shown_by)}
            for d in found.directions
        ),
    )  # fmt: skip


def to_json(found: Observability) -> str:
    """All numbers."""
    data: dict[str, Any] = {
        "scenario": found.scenario, "window": found.window,
        "eigenvalues": found.eigenvalues.tolist(),
        "coordinates": [
            {"name": name, "unit": unit, "std": float(std), "left": _finite(left),
             "seen_from": _finite(seen)}
            for name, unit, std, left, seen in zip(
                found.names, found.units, found.std, found.left, found.seen_from
            )
        ],
        "directions": [
            {"text": d.text, "seen_from": d.seen_from, "left": d.left,
             "shown_by": [{"motion": name, "left": left} for name, left in d.shown_by]}
            for d in found.directions
        ],
    }  # fmt: skip
    return json.dumps(data, indent=2)


def _motion(d: Direction) -> str:
    if d.seen_from is not None:
        return ""
    if not d.shown_by:
        return "none that was tried"
    return "; ".join(f"{name} ({_percent(left)})" for name, left in d.shown_by)


def _percent(x: float) -> str:
    return f"{100 * x:.3g}%" if np.isfinite(x) else "known"


def _time(t: float, left: float) -> str:
    return number(t) if np.isfinite(t) else "never" if np.isfinite(left) else ""


def _finite(x: float) -> float | None:
    return float(x) if np.isfinite(x) else None
