"""What the sensors of many robots say, each robot at its own time since its reset."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from math import gcd

import mujoco
import numpy as np
from numpy.typing import NDArray

from estbench.envs.errors import EnvError
from estbench.envs.flaws import Flaws
from estbench.envs.keys import Keys, Mask
from estbench.models import layout
from estbench.models.mujoco import needed_stage
from estbench.models.rows import Rows
from estbench.sensors import Channel

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Reading:
    """What arrived at one instant.

    Attributes:
        y: `(row, ny)`; only the components that arrived mean anything.
        channels: names of the channels that are due in any row.
        arrived: components that arrived `(row, m)`; None is all.
    """

    y: Array
    channels: tuple[str, ...]
    arrived: Mask | None


class Readings:
    """Readings of `rows` robots by sensors as they are.

    Args:
        model: compiled model that holds the sensors.
        channels: sensors in use.
        rows: how many robots.
        nthread: threads of the batch.
        quiet: names of channels without white noise, whatever R is believed.

    Attributes:
        space: the manifold of all channels' readings, one after the other.
        slots: channel -> its place in the tangent of `space`.
        last: the last reading of every channel `(row, ny)`.
        tick: physics steps since the reset `(row,)`.

    Raises:
        EnvError: a channel has latency or jitter.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        channels: Sequence[Channel],
        rows: int,
        nthread: int = 1,
        quiet: Collection[str] = (),
    ):
        for c in channels:
            if not c.timing.punctual:
                raise EnvError(
                    f"channels.{c.name} has latency or jitter; an environment fuses readings at the "
                    "time they are due, so set both to 0 here (`estbench run` handles them)"
                )
        self.channels = tuple(channels)
        self.space = layout.sensor_space(model, [c.index for c in channels])
        self.slots: dict[str, slice] = {}
        start = 0
        for c in channels:
            self.slots[c.name] = slice(start, start + c.space.n)
            start += c.space.n
        starts = np.cumsum([0] + [c.space.nx for c in channels])
        self._points = [slice(int(a), int(b)) for a, b in zip(starts, starts[1:])]
        self._flaws = [Flaws(c, rows, c.name in quiet) for c in channels]
        # Rhythms: (period, first reading) of channels that deliver together.
        self._rhythms = sorted({(c.timing.period, c.timing.phase) for c in channels})
        self._of = [self._rhythms.index((c.timing.period, c.timing.phase)) for c in channels]
        self._model, self._rows = model, Rows(model, nthread)
        self._timestep = float(model.opt.timestep)
        self._plans: dict[tuple[int, ...], tuple[NDArray[np.intp], int]] = {}
        self.tick = np.zeros(rows, np.int64)
        self.last = np.zeros((rows, self.space.nx))

    def start(self, mask: Mask, keys: Keys, x: Array, u: Array) -> None:
        """Begin episodes in the rows of a mask, with a first look at every channel.

        It is kept in `last` for those who use raw readings. A filter is not given it: its first
        measurement comes one period after the start.

        Args:
            mask: `(row,)`.
            keys: random keys of these rows `(mask.sum(),)`.
            x: true states of all rows `(row, nx)`.
            u: controls `(row, nu)`.
        """
        self.tick[mask] = 0
        every, time = tuple(range(len(self.channels))), self.tick * self._timestep
        clean = self._clean(every, x, u, 0.0)
        for flaws, part in zip(self._flaws, self._points):
            flaws.start(mask, keys, clean[:, part])
            y, _ = flaws.read(clean[:, part], time, mask, keep=False)
            self.last[mask, part] = y[mask]

    def stride(self, steps: int) -> int:
        """The most physics steps that divide `steps` and miss no reading, whatever the phase.

        It does not depend on where the rows are, so a row is the same in any company.
        """
        return gcd(steps, *(n for rhythm in self._rhythms for n in rhythm if n))

    def take(
        self, steps: int, x: Array, u: Array, t: float, mask: Mask | None = None
    ) -> Reading | None:
        """Let physics steps pass, up to the states x, and read what is due there.

        Args:
            steps: physics steps since the last call.
            x: true states `(row, nx)`.
            u: controls `(row, nu)`.
            t: time at x, s.
            mask: rows for which time passes; None is all.

        Returns:
            What arrived, or None if nothing is due in any row.
        """
        self.tick += steps if mask is None else steps * mask
        due = [self._due(*rhythm, mask) for rhythm in self._rhythms]
        taking = tuple(i for i, r in enumerate(self._of) if due[r] is not False)
        if not taking:
            return None
        clean, time = self._clean(taking, x, u, t), self.tick * self._timestep
        parts, arrived, start = [], [], 0
        for i in taking:
            width = self.channels[i].space.nx
            rows = due[self._of[i]]
            rows = None if rows is True else rows
            y, arrives = self._flaws[i].read(clean[:, start : start + width], time, rows)
            here = rows if arrives is None else arrives if rows is None else rows & arrives
            part = self._points[i]
            self.last[:, part] = y if here is None else np.where(here[:, None], y, self.last[:, part])
            parts.append(y)
            arrived.append(here)
            start += width
        names = tuple(self.channels[i].name for i in taking)
        y = np.concatenate(parts, axis=1) if len(parts) > 1 else parts[0]
        if all(here is None for here in arrived):
            return Reading(y, names, None)
        columns = [
            np.broadcast_to(True if here is None else here[:, None], (len(x), c.space.n))
            for here, c in zip(arrived, (self.channels[i] for i in taking))
        ]
        return Reading(y, names, np.concatenate(columns, axis=1))

    def _due(self, period: int, phase: int, mask: Mask | None) -> Mask | bool:
        """Rows in which a rhythm is due; True for all, False for none."""
        since = self.tick - (phase or period)
        due = (since >= 0) & (since % period == 0)
        if mask is not None:
            due &= mask
        return True if due.all() else due if due.any() else False

    def _clean(self, channels: tuple[int, ...], x: Array, u: Array, t: float) -> Array:
        """Noise-free readings `(row, ny)` of some channels, one after the other."""
        if channels not in self._plans:
            chosen = [self.channels[i] for i in channels]
            columns = np.concatenate([c.columns for c in chosen])
            self._plans[channels] = (columns, needed_stage(self._model, [c.index for c in chosen]))
        columns, stage = self._plans[channels]
        return self._rows.read(x, u, t, stage, columns)
