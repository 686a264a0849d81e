"""The true state in a log: read, interpolated on the manifold, in the frame of the model."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from estbench.errors import LogError, did_you_mean
from estbench.logs import clock
from estbench.logs.frames import Rigid, fitted
from estbench.logs.readings import scaled, table_with
from estbench.logs.table import LogTable
from estbench.robots.layout import state_names
from estbench.scenario.log import LogSection, TruthColumns, TruthSection
from estbench.shapes import Array, Bool, Float, Int, Ints, Mask
from estbench.spaces import rotation
from estbench.spaces.manifold import Manifold

GROUPS = {
    "": ("x", "y", "z", "qw", "qx", "qy", "qz"),
    ".position": ("x", "y", "z"),
    ".rotation": ("qw", "qx", "qy", "qz"),
    ".vel": ("vx", "vy", "vz", "wx", "wy", "wz"),
}
"""What follows the name of a joint -> the numbers of the state that are meant."""


@dataclass(frozen=True, eq=False)
class Part:
    """What one entry of `[log.truth.states]` says.

    Attributes:
        at: its numbers in the state.
        to: its coordinates in the tangent.
        times: s since the start, rising `(k,)`.
        values: `(k, numbers)`.
        noise: σ of each coordinate.
    """

    at: Int[Ints, " c"]
    to: Int[Ints, " n"]
    times: Float[Array, " k"]
    values: Float[Array, "k c"]
    noise: Float[Array, " n"]


@dataclass(frozen=True, eq=False)
class Truth:
    """The true state at the times of a log.

    Attributes:
        x: NaN where it is not known.
        known: coordinates of the tangent that are known.
        noise: σ of the truth itself, of each coordinate.
    """

    x: Float[Array, "time nx"]
    known: Bool[Mask, "time n"]
    noise: Float[Array, " n"]


def parts(
    tables: Sequence[LogTable], log: LogSection, section: TruthSection, space: Manifold,
    start: float,
) -> list[Part]:  # fmt: skip
    """The parts of the true state that the log has.

    Args:
        tables: its files.
        log: `[log]`.
        section: `[log.truth]`.
        space: of the state.
        start: of the log by its clock, s.

    Raises:
        LogError: an entry does not fit the state or the log.
    """
    if not section.states:
        raise LogError("log.truth.states is empty; name a part of the state and its columns")
    names = state_names(space)
    owner = dict[int, str]()
    found = []
    for name, entry in section.states.items():
        key = f"log.truth.states.{name}"
        at = _numbers(name, names, key)
        for i in at:
            if i in owner:
                raise LogError(f"{key}: {names[i]} is mapped by '{owner[int(i)]}' already")
            owner[int(i)] = name
        found.append(_part(tables, log, section, entry, key, at, space, start))
    return found


def _numbers(name: str, names: Sequence[str], key: str) -> Int[Ints, " c"]:
    """The numbers of the state that a name means."""
    if name in names:
        return np.array([names.index(name)])
    for ending, group in GROUPS.items():
        joint = name.removesuffix(ending)
        if ending and joint == name:
            continue
        at = [names.index(f"{joint}.{part}") for part in group if f"{joint}.{part}" in names]
        if at:
            return np.array(at)
    joints = {n.rsplit(".", 1)[0] for n in names if "." in n}
    raise LogError(f"{key}: the state has no such part{did_you_mean(name, {*names, *joints})}")


def _part(
    tables: Sequence[LogTable], log: LogSection, section: TruthSection, entry: TruthColumns,
    key: str, at: Int[Ints, " c"], space: Manifold, start: float,
) -> Part:  # fmt: skip
    names = state_names(space)
    if len(entry.columns) != len(at):
        raise LogError(
            f"{key}.columns has {len(entry.columns)} columns; the part has {len(at)} numbers "
            f"({', '.join(names[i] for i in at)})"
        )
    to = _coordinates(space, at, key)
    noise = np.atleast_1d(np.asarray(entry.noise, np.float64))
    if len(noise) not in (1, len(to)):
        raise LogError(f"{key}.noise has {len(noise)} numbers; give one, or {len(to)}")
    table = table_with(tables, entry.columns, key)
    values = scaled(table, entry, key)
    rows = np.flatnonzero(np.isfinite(values).all(axis=1))
    if len(rows) < 2:
        raise LogError(f"{table.title}: {key} has {len(rows)} rows with numbers; it needs two")
    stamped = clock.find(table, entry.time or section.time or log.time)
    times = clock.stamps(table, stamped, log.unit, f"{key}.time", rows) + section.offset - start
    order = np.argsort(times, kind="stable")
    times, rows = times[order], rows[order]
    rising = np.append(np.diff(times) > 0, True)  # of equal stamps the last counts
    return Part(at, to, times[rising], values[rows[rising]], np.broadcast_to(noise, len(to)).copy())


def _coordinates(space: Manifold, at: Int[Ints, " c"], key: str) -> Int[Ints, " n"]:
    """The tangent coordinates of some numbers of the state."""
    out, left = [], set(at.tolist())
    for i in at.tolist():
        turn = next(((q, v) for q, v in space.quaternions.tolist() if q <= i < q + 4), None)
        if turn is None:
            out.append(i - int((space.quaternions[:, 0] < i).sum()))
        elif i == turn[0]:
            out += range(turn[1], turn[1] + 3)
        if turn is not None and not set(range(turn[0], turn[0] + 4)) <= left:
            raise LogError(f"{key}: a rotation needs its four numbers qw, qx, qy, qz")
    return np.array(out)


def at_times(
    found: Sequence[Part], section: TruthSection, space: Manifold, times: Float[Array, " time"]
) -> Truth:
    """The true state at some times, in the frame of the log.

    Numbers are interpolated linearly, rotations along the shortest rotation. At a time stamp of the
    truth it is its value to the last bit.

    Args:
        found: of `parts`.
        section: `[log.truth]`.
        space: of the state.
        times: s since the start.
    """
    x = np.full((len(times), space.nx), np.nan)
    noise = np.zeros(space.n)
    known = np.zeros((len(times), space.n), bool)
    for part in found:
        k = np.clip(np.searchsorted(part.times, times, "right") - 1, 0, len(part.times) - 2)
        left, right = part.times[k], part.times[k + 1]
        share = (times - left) / (right - left)
        inside = (share >= 0) & (share <= 1)
        inside &= (right - left <= section.longest_gap) | (share == 0) | (share == 1)
        value = part.values[k] + share[:, None] * (part.values[k + 1] - part.values[k])
        for first in _rotations(space, part):
            turn = slice(first, first + 4)
            q, p = (rotation.normalize(part.values[i][:, turn]) for i in (k, k + 1))
            delta = rotation.log(rotation.multiply(rotation.conjugate(q), p))
            value[:, turn] = rotation.multiply(q, rotation.exp(share[:, None] * delta))
        value = np.where((share == 0)[:, None], part.values[k], value)
        value = np.where((share == 1)[:, None], part.values[k + 1], value)
        x[:, part.at] = np.where(inside[:, None], value, np.nan)
        known[:, part.to] = inside[:, None]
        noise[part.to] = part.noise
    return Truth(x, known, noise)


def _rotations(space: Manifold, part: Part) -> list[int]:
    """Where a part has the first numbers of quaternions."""
    numbers = part.at.tolist()
    return [numbers.index(q) for q in space.quaternions[:, 0].tolist() if q in numbers]


def bodies(space: Manifold) -> Mapping[str, tuple[slice, slice, slice]]:
    """Free joints: name -> where its position, its rotation and its velocity are in the state."""
    names = state_names(space)
    return {
        name.removesuffix(".x"): (
            slice(i, i + 3),
            slice(i + 3, i + 7),
            slice(v := names.index(f"{name.removesuffix('.x')}.vx"), v + 3),
        )
        for i, name in enumerate(names)
        if name.endswith(".x") and f"{name.removesuffix('.x')}.qw" in names
    }


def transform(
    section: TruthSection, truth: Truth, space: Manifold, estimate: Float[Array, "time nx"]
) -> Rigid | None:
    """From the frame of the truth to that of the model; None where it is the same.

    Args:
        section: `[log.truth]`.
        truth: in its own frame.
        space: of the state.
        estimate: x̂, to which a frame is fitted.

    Raises:
        LogError: no frame can be fitted.
    """
    if section.frame == "model":
        return None
    if section.frame == "given":
        return Rigid(rotation.normalize(np.array(section.rotation)), np.array(section.translation))
    free = bodies(space)
    if not free:
        raise LogError(
            'log.truth.frame is "estimated" and the robot has no free joint; use "given" or "model"'
        )
    place = next(iter(free.values()))[0]
    p, q = truth.x[:, place], estimate[:, place]
    both = np.isfinite(p).all(axis=1) & np.isfinite(q).all(axis=1)
    return fitted(p[both], q[both])


def moved(truth: Truth, space: Manifold, rigid: Rigid | None) -> Truth:
    """The truth in the frame of the model: the poses and the velocities of free joints turn."""
    if rigid is None:
        return truth
    x = truth.x.copy()
    for position, turn, velocity in bodies(space).values():
        x[:, position] = rigid.points(x[:, position])
        x[:, turn] = rigid.rotations(x[:, turn])
        x[:, velocity] = rigid.vectors(x[:, velocity])
    return Truth(x, truth.known, truth.noise)


def true_states(space: Manifold, prefix: str) -> dict[str, TruthColumns]:
    """Where the true state is, in columns that are called by a prefix and the number's name."""
    numbers = state_names(space)
    turns = [q for q, _ in space.quaternions.tolist()]
    return {
        name.removesuffix(".qw") + ".rotation" if i in turns else name: TruthColumns(
            columns=[f"{prefix}{n}" for n in numbers[i : i + 4 if i in turns else i + 1]]
        )
        for i, name in enumerate(numbers)
        if not any(q < i < q + 4 for q in turns)
    }
