"""What the sensors of many robots say, each robot at its own time since its reset."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from math import gcd

import mujoco
import numpy as np
from numpy.typing import NDArray

from estbench.envs.delay import Delay
from estbench.envs.errors import EnvError
from estbench.envs.flaws import Flawed, Source, White
from estbench.envs.keys import Keys, Mask
from estbench.envs.replay import Measurement
from estbench.robots import backend, layout
from estbench.robots.measurement import Plan
from estbench.sensors.channel import Channel
from estbench.shapes import Array


@dataclass(frozen=True, eq=False)
class _Group:
    """Channels that are read together.

    Attributes:
        channels: their numbers, in order.
        names: their names.
        period, phase: in physics steps; the first reading is at `phase`, or at `period`.
        source: their noise and imperfections.
        delay: until their readings arrive, or None for none.
        point: their columns in the point of all readings.
        width: count of components.
    """

    channels: tuple[int, ...]
    names: tuple[str, ...]
    period: int
    phase: int
    source: Source
    delay: Delay | None
    point: NDArray[np.intp]
    width: int


class Readings:
    """Readings of `rows` robots by sensors as they are.

    Args:
        model: compiled model that holds the sensors.
        channels: sensors in use.
        rows: how many robots.
        nthread: threads of the batch.
        quiet: names of channels without white noise, whatever R is believed.
        look: whether every episode begins with a look at the sensors, kept in `last`.

    Attributes:
        channels: sensors in use.
        space: the manifold of all channels' readings, one after the other.
        slots: channel -> its place in the tangent of `space`.
        last: the last reading of every channel `(row, ny)`.
        tick: physics steps since the reset `(row,)`.
        latest: the largest of them.

    Raises:
        EnvError: a channel has jitter.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        channels: Sequence[Channel],
        rows: int,
        nthread: int = 1,
        quiet: Collection[str] = (),
        look: bool = True,
    ):
        for c in channels:
            if c.timing.jitter:
                raise EnvError(
                    f"channels.{c.name}.jitter: an environment samples when a reading is due; set "
                    "it to 0 here (`estbench run` handles it)"
                )
        self.channels = tuple(channels)
        self.space = layout.sensor_space(model, [c.index for c in channels])
        self.slots: dict[str, slice] = {}
        start = 0
        for c in channels:
            self.slots[c.name] = slice(start, start + c.space.n)
            start += c.space.n
        self._model, self._backend = model, backend.create(model, nthread)
        self._timestep = float(model.opt.timestep)
        self._groups = self._grouped(rows, frozenset(quiet))
        self._late = [group for group in self._groups if group.delay is not None]
        self._plans: dict[tuple[int, ...], Plan] = {}
        # A stuck sensor repeats what it saw, so it has to have seen something.
        self._look = look or any(
            c.imperfections is not None and c.imperfections.stuck for c in channels
        )
        self.tick = np.zeros(rows, np.int64)
        self.latest, self._together = 0, False
        self._no_row = np.zeros(rows, bool)
        self.last = np.zeros((rows, self.space.nx))

    def start(self, mask: Mask, keys: Keys, x: Array, u: Array) -> None:
        """Begin episodes in the rows of a mask, with a first look at every channel.

        It is for those who use raw readings. A filter is not given it: its first
        measurement comes one period after the start.

        Args:
            mask: `(row,)`.
            keys: random keys of these rows `(mask.sum(),)`.
            x: true states of all rows `(row, nx)`.
            u: controls `(row, nu)`.
        """
        self.tick[mask] = 0
        self.latest, self._together = int(self.tick.max()), bool(mask.all())
        time: Array = self.tick * self._timestep
        rows = None if mask.all() else mask
        seen = (
            self._clean(tuple(range(len(self._groups))), x, u, 0.0)
            if self._look or rows is None
            else [(group, self.last[:, group.point]) for group in self._groups]
        )
        for group, clean in seen:
            group.source.start(mask, keys, clean)
            if group.delay is not None:
                group.delay.start(mask, keys)
            y, _ = group.source.read(clean, time, rows, keep=False)
            self.last[np.ix_(mask, group.point)] = y[mask]

    def depth(self, stride: int) -> int:
        """How many strides of physics steps late a reading may be (five standard deviations)."""
        late = (c.timing.longest_delay for c in self.channels)
        return -(-max(late, default=0) // stride)

    def stride(self, steps: int) -> int:
        """The most physics steps that divide `steps` and miss no reading, whatever the phase.

        It does not depend on where the rows are, so a row is the same in any company.
        """
        return gcd(steps, *(n for g in self._groups for n in (g.period, g.phase) if n))

    def take(self, steps: int, x: Array, u: Array, mask: Mask | None = None) -> list[Measurement]:
        """Let physics steps pass, up to the states x; take what is due and hand out what arrives.

        Args:
            steps: physics steps since the last call.
            x: true states `(row, nx)`.
            u: controls `(row, nu)`.
            mask: rows for which time passes; None is all.

        Returns:
            What arrived: readings of now together, late ones by their age.
        """
        self.tick += steps if mask is None else steps * mask
        self._together = self._together and mask is None
        self.latest = self.latest + steps if self._together else int(self.tick.max())
        due = {}
        for i, group in enumerate(self._groups):
            rows = self._due(group, mask)
            if rows is None or rows.any():
                due[i] = rows
        arrived, now = [], []
        if due:
            time: Array = self.tick * self._timestep
            clean = self._clean(tuple(due), x, u, self.latest * self._timestep)
            for rows, (group, true) in zip(due.values(), clean):
                y, arrives = group.source.read(true, time, rows)
                here = rows if arrives is None else arrives if rows is None else rows & arrives
                if group.delay is not None:
                    group.delay.send(y, here, rows, self.tick)
                    continue
                self._see(group, y, here)
                now.append((group, y, here))
        if now:
            arrived.append(self._joined(now))
        for group in self._late:
            for y, here, age in group.delay.receive(self.tick) if group.delay else ():
                self._see(group, y, here)
                arrived.append(replace(self._joined([(group, y, here)]), age=age))
        return arrived

    def _see(self, group: _Group, y: Array, here: Mask | None) -> None:
        if here is None:
            self.last[:, group.point] = y
        else:
            self.last[np.ix_(here, group.point)] = y[here]

    def _joined(self, parts: list[tuple[_Group, Array, Mask | None]]) -> Measurement:
        """The readings of some groups, channels in the robot's order."""
        if len(parts) == 1:
            group, y, here = parts[0]
            whole = here is None
            arrived = None if whole else np.repeat(here[:, None], group.width, axis=1)
            return Measurement(y, group.names, arrived)
        by_channel = {}
        for group, y, here in parts:
            start = 0
            for i in group.channels:
                stop = start + self.channels[i].space.nx
                by_channel[i] = (y[:, start:stop], here)
                start = stop
        order = sorted(by_channel)
        y = np.concatenate([by_channel[i][0] for i in order], axis=1)
        arrived = None
        if any(here is not None for _, here in by_channel.values()):
            columns = []
            for i in order:
                here = by_channel[i][1]
                shape = (len(y), self.channels[i].space.n)
                columns.append(np.broadcast_to(True if here is None else here[:, None], shape))
            arrived = np.concatenate(columns, axis=1)
        return Measurement(y, tuple(self.channels[i].name for i in order), arrived)

    def _due(self, group: _Group, mask: Mask | None) -> Mask | None:
        """Rows in which a group is due; None for all."""
        first = group.phase or group.period
        if self._together:
            late = self.latest - first
            return None if late >= 0 and late % group.period == 0 else self._no_row
        since = self.tick - first
        due = (since >= 0) & (since % group.period == 0)
        if mask is not None:
            due &= mask
        return None if due.all() else due

    def _clean(
        self, groups: tuple[int, ...], x: Array, u: Array, t: float
    ) -> list[tuple[_Group, Array]]:
        """Noise-free readings `(row, ny)` of some groups."""
        chosen = [self._groups[i] for i in groups]
        if groups not in self._plans:
            sources = [self.channels[c].measurand for g in chosen for c in g.channels]
            self._plans[groups] = Plan(self._model, sources)
        y, out, start = self._plans[groups].read(self._backend, x, u, t), [], 0
        for group in chosen:
            out.append((group, y[:, start : start + len(group.point)]))
            start += len(group.point)
        return out

    def _grouped(self, rows: int, quiet: frozenset[str]) -> list[_Group]:
        """Channels with white noise only and one rhythm together, every other one by itself."""
        members: dict[tuple[int, int, int], list[int]] = {}
        for i, c in enumerate(self.channels):
            plain = c.imperfections is None and c.schedule is None and c.timing.punctual
            key = (c.timing.period, c.timing.phase, -1 if plain else i)
            members.setdefault(key, []).append(i)
        starts = np.cumsum([0] + [c.space.nx for c in self.channels])
        groups = []
        for (period, phase, alone), numbers in members.items():
            chosen = [self.channels[i] for i in numbers]
            space = layout.sensor_space(self._model, [c.index for c in chosen])
            source: Source = (
                White(chosen, space, rows, quiet)
                if alone < 0
                else Flawed(chosen[0], rows, chosen[0].name in quiet)
            )
            groups.append(
                _Group(
                    channels=tuple(numbers),
                    names=tuple(c.name for c in chosen),
                    period=period,
                    phase=phase,
                    source=source,
                    delay=None if chosen[0].timing.punctual else Delay(chosen[0], rows),
                    point=np.concatenate([np.arange(starts[i], starts[i + 1]) for i in numbers]),
                    width=space.n,
                )
            )
        return groups
