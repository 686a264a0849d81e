"""A first section `[log]` for a scenario: the columns that fit its channels by name and unit."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher
from itertools import product

import numpy as np

from estbench.experiment.setup import build
from estbench.logs import bags, clock
from estbench.logs.readings import TOO_LARGE
from estbench.logs.table import LogTable
from estbench.robots.layout import control_names
from estbench.scenario.schema import Scenario
from estbench.shapes import Array
from estbench.spaces.manifold import Manifold

WORDS: Mapping[str, tuple[str, ...]] = {
    "rad": ("pos", "position", "angle", "q", "encoder", "orientation", "joint"),
    "m": ("pos", "position", "height", "distance", "cart"),
    "rad/s": ("vel", "velocity", "speed", "qd", "gyro", "angular", "omega", "w", "rate"),
    "m/s": ("vel", "velocity", "speed", "linear", "twist"),
    "m/s²": ("acc", "accel", "acceleration", "accelerometer", "linear"),
    "N": ("force", "effort"),
    "N m": ("tau", "torque", "effort", "u", "current", "ctrl", "control"),
    "T": ("mag", "magnetometer", "magnetic"),
}
"""What the heading of a column of this unit says."""
OTHERS = ("con", "cmd", "command", "des", "desired", "ref", "covariance", "truth", "gt", "mocap")
"""What the heading of a column says that is none of a sensor."""
WIDEST = 78
"""Characters of a line of TOML; longer lists have a line for each column."""
LEAST = 1.0
"""Score below which a column is not taken: nothing in its heading speaks for it."""


@dataclass(frozen=True)
class Match:
    """The columns of a channel or of an actuator.

    Attributes:
        name: of the channel or actuator.
        columns: in the order of its axes; empty if none fits.
        unit: that the range suggests in place of the SI unit, or empty.
    """

    name: str
    columns: tuple[str, ...]
    unit: str = ""


def section(tables: Sequence[LogTable], scenario: Scenario) -> str:
    """The section in TOML, to be corrected by hand; what has no column is a comment.

    Raises:
        EstbenchError: the scenario cannot be built.
    """
    prepared = build(scenario)
    columns = {
        name: values
        for table in tables
        for name, values in table.columns.items()
        if name not in (*clock.NAMES, bags.STAMP, bags.RECEIVED) and np.isfinite(values).any()
    }
    free = dict(columns)
    channels = _matched(prepared.channel_spaces, free)
    actuators = {
        name: Manifold.euclidean(1, (name,), ("N m",))
        for name in control_names(prepared.plant.model)
    }
    controls = _matched(actuators, free, ())
    lines = []
    for kind, found in (("channels", channels), ("controls", controls)):
        for match in found:
            lines.append("")
            if not match.columns:
                lines.append(f"# no column fits {kind[:-1]} {match.name}")
                continue
            listed = [f'"{column}"' for column in match.columns]
            line = f"columns = [{', '.join(listed)}]"
            if len(line) > WIDEST:
                line = "\n".join(["columns = [", *(f"    {column}," for column in listed), "]"])
            lines += [f"[log.{kind}.{key(match.name)}]", line]
            lines += [f'unit = "{match.unit}"'] if match.unit else []
    return "\n".join(lines)


def key(name: str) -> str:
    """A name as a key of TOML."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else f'"{name}"'


def _matched(
    spaces: Mapping[str, Manifold], free: dict[str, Array], others: Sequence[str] = OTHERS
) -> list[Match]:
    """The columns of each name, best first; a column is taken once and leaves `free`."""
    groups = _groups(free)
    said = [set(_words(column)) for column in free]
    rare = {
        word: 1 - sum(word in words for words in said) / len(said) for word in set().union(*said)
    }
    scored = sorted(
        (
            (score, name, group)
            for (name, space), group in product(spaces.items(), groups)
            if len(group) == space.nx
            and (score := _score(name, space, group, free, rare, others)) >= LEAST
        ),
        key=lambda s: -s[0],
    )
    taken: dict[str, tuple[str, ...]] = {}
    for _, name, group in scored:
        if name not in taken and all(column in free for column in group):
            taken[name] = group
            values = {column: free.pop(column) for column in group}
            spaces_unit = spaces[name].units[0]
            if _degrees(spaces[name], values):
                taken[name] = (*group, spaces_unit.replace("rad", "deg"))
    _in_order(spaces, taken)
    return [
        Match(name, found[: space.nx], "".join(found[space.nx :]))
        for name, space in spaces.items()
        for found in (taken.get(name, ()),)
    ]


def _in_order(spaces: Mapping[str, Manifold], taken: dict[str, tuple[str, ...]]) -> None:
    """Give columns that differ in a digit alone to the names in their order."""
    alike: dict[tuple[str, ...], list[str]] = {}
    for name, space in spaces.items():
        if name in taken:
            alike.setdefault((*space.units, *_words(taken[name][0])), []).append(name)
    for names in alike.values():
        for name, group in zip(names, sorted(taken[name] for name in names)):
            taken[name] = group


def _groups(columns: Mapping[str, Array]) -> list[tuple[str, ...]]:
    """Single columns, and those whose headings differ in their last axis: x y z, 0 1 2, w x y z."""
    families: dict[str, dict[str, str]] = {}
    for name in columns:
        end = re.fullmatch(r"(.*?)[._\[]?([wxyz]|\d)\]?", name)
        if end:
            families.setdefault(end[1], {})[end[2]] = name
    out: list[tuple[str, ...]] = [(name,) for name in columns]
    for family in families.values():
        for axes in ("wxyz", "xyz", "0123", "012", "123", "1234", "01", "12"):
            if all(axis in family for axis in axes):
                out.append(tuple(family[axis] for axis in axes))
    return out


def _score(
    name: str, space: Manifold, group: Sequence[str], columns: Mapping[str, Array],
    rare: Mapping[str, float], others: Sequence[str],
) -> float:  # fmt: skip
    """How well the headings of some columns fit a name and its unit.

    A word that many headings have says little: `rare` is the share of those without it.
    """
    words = set(_words(group[0]))
    unit = space.units[0]
    alike = SequenceMatcher(None, " ".join(_words(name)), " ".join(_words(group[0]))).ratio()
    own = set(_words(name))
    score = (
        alike
        + 2.0 * max((rare[w] for w in own & words), default=0.0)
        + 1.0 * bool(words & set(WORDS.get(unit, ())))
    )
    score -= 1.0 * bool(words & set(others))
    for other, listed in WORDS.items():  # of another unit, and not of this one
        if other != unit and words & set(listed) and not words & set(WORDS.get(unit, ())):
            score -= 1.5
            break
    largest = max(float(np.nanmax(np.abs(columns[column]))) for column in group)
    if not space.flat and largest > 1.5:
        score -= 2.0  # no unit quaternion
    return score


def _words(name: str) -> list[str]:
    """The words of a heading: parts between signs, digits, and changes of case."""
    spaced = re.sub(r"([a-z])([A-Z])", r"\1 \2", name)
    return re.findall(r"[a-z]+", spaced.lower())


def _degrees(space: Manifold, values: Mapping[str, Array]) -> bool:
    """Whether the ranges, or the headings, of angles look like degrees."""
    limit = TOO_LARGE.get(space.units[0])
    if limit is None or not space.flat:
        return False
    largest = max(float(np.nanmax(np.abs(v))) for v in values.values())
    return largest > limit or any("deg" in _words(column) for column in values)
