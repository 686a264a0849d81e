"""What the sensors of many robots say, each robot at its own time since its reset."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from math import gcd

import mujoco
import numpy as np
from numpy.typing import NDArray

from estbench.envs.keys import Keys, Mask, RowNoise
from estbench.manifold import Manifold
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
    """Noisy readings of `rows` robots.

    Args:
        model: compiled model that holds the sensors.
        channels: sensors in use.
        rows: how many robots.
        nthread: threads of the batch.
        quiet: names of channels that read without noise, whatever R is believed.

    Attributes:
        space: the manifold of all channels' readings, one after the other.
        slots: channel -> its place in the tangent of `space`.
        last: the last reading of every channel `(row, ny)`.
        tick: physics steps since the reset `(row,)`.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        channels: Sequence[Channel],
        rows: int,
        nthread: int = 1,
        quiet: Collection[str] = (),
    ):
        self.channels, self._quiet = tuple(channels), frozenset(quiet)
        self.space = layout.sensor_space(model, [c.index for c in channels])
        self.slots: dict[str, slice] = {}
        start = 0
        for c in channels:
            self.slots[c.name] = slice(start, start + c.space.n)
            start += c.space.n
        self._model, self._rows = model, Rows(model, nthread)
        # Channels of one period deliver together, so they share a count of readings.
        self._periods = sorted({c.period for c in channels})
        self._noise = [
            RowNoise(
                rows, {f"sensor:{c.name}": c.space.n for c in channels if c.period == period}
            )
            for period in self._periods
        ]
        self._plans: dict[tuple[int, ...], _Plan] = {}
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
        for noise in self._noise:
            noise.start(mask, keys)
        self.tick[mask] = 0
        plan = self._plan(tuple(range(len(self._periods))))
        y = self._disturbed(plan, x, u, 0.0, [mask] * len(self._periods))
        self.last[mask] = y[mask]

    def stride(self, steps: int) -> int:
        """The most physics steps that divide `steps` and miss no reading, whatever the phase.

        It does not depend on where the rows are, so a row is the same in any company.
        """
        return gcd(steps, *self._periods)

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
        due = [self.tick % period == 0 for period in self._periods]
        if mask is not None:
            due = [d & mask for d in due]
        active = tuple(g for g, d in enumerate(due) if d.any())
        if not active:
            return None
        plan = self._plan(active)
        whole = all(due[g].all() for g in active)
        y = self._disturbed(plan, x, u, t, [None if whole else due[g] for g in active])
        if whole:
            self.last[:, plan.point] = y
            return Reading(y, plan.names, None)
        here = np.stack([due[g] for g in active], axis=1)
        self.last[:, plan.point] = np.where(here[:, plan.point_group], y, self.last[:, plan.point])
        return Reading(y, plan.names, here[:, plan.tangent_group])

    def _disturbed(
        self, plan: "_Plan", x: Array, u: Array, t: float, due: Sequence[Mask | None]
    ) -> Array:
        y = self._rows.read(x, u, t, plan.stage, plan.columns)
        white = np.empty((len(x), plan.space.n))
        for place, group in enumerate(plan.groups):
            white[:, plan.tangent_group == place] = self._noise[group].draw(due[place])
        if plan.std is not None:
            return plan.space.plus(y, plan.std * white)
        # A stack of small products: one large product would depend on the count of rows.
        return plan.space.plus(y, (plan.factor @ white[..., None])[..., 0])

    def _plan(self, active: tuple[int, ...]) -> "_Plan":
        if active not in self._plans:
            self._plans[active] = self._make_plan(active)
        return self._plans[active]

    def _make_plan(self, active: tuple[int, ...]) -> "_Plan":
        place = {self._periods[g]: i for i, g in enumerate(active)}
        chosen = [c for c in self.channels if c.period in place]
        widths_x, widths_t = [c.space.nx for c in chosen], [c.space.n for c in chosen]
        starts = np.cumsum([0] + [c.space.nx for c in self.channels])
        point = [
            np.arange(start, start + c.space.nx)
            for start, c in zip(starts, self.channels)
            if c.period in place
        ]
        groups = [place[c.period] for c in chosen]
        factor = np.zeros((sum(widths_t), sum(widths_t)))
        at = 0
        for c, width in zip(chosen, widths_t):
            if c.name not in self._quiet:
                factor[at : at + width, at : at + width] = np.linalg.cholesky(c.cov)
            at += width
        diagonal = np.diagonal(factor)
        indices = [c.index for c in chosen]
        return _Plan(
            groups=active,
            names=tuple(c.name for c in chosen),
            columns=np.concatenate([c.columns for c in chosen]),
            stage=needed_stage(self._model, indices),
            space=layout.sensor_space(self._model, indices),
            point=np.concatenate(point),
            point_group=np.repeat(groups, widths_x),
            tangent_group=np.repeat(groups, widths_t),
            factor=factor,
            std=diagonal.copy() if np.array_equal(factor, np.diag(diagonal)) else None,
        )


@dataclass(frozen=True, eq=False)
class _Plan:
    """How to read the channels of some periods.

    Attributes:
        groups: indices of the periods.
        names: channels, in the robot's order.
        columns: of sensordata.
        stage: pipeline stage they need.
        space: manifold of these readings.
        point: their columns in the point of all readings.
        point_group, tangent_group: which of `groups` a column belongs to.
        factor: Cholesky factor of R; `std` is its diagonal if it has nothing else.
    """

    groups: tuple[int, ...]
    names: tuple[str, ...]
    columns: NDArray[np.intp]
    stage: int
    space: Manifold
    point: NDArray[np.intp]
    point_group: NDArray[np.intp]
    tangent_group: NDArray[np.intp]
    factor: Array
    std: Array | None
