"""All sensors of many robots: true readings taken together, and what each channel makes of them."""

from collections.abc import Sequence

import mujoco
import numpy as np

from estbench.randomness import streams
from estbench.randomness.streams import Seeds
from estbench.robots.backend import Backend
from estbench.robots.measurement import Plan
from estbench.sensors.channel import Channel
from estbench.sensors.delivery import Delivery, divided
from estbench.sensors.sampling import Sampler, alike
from estbench.shapes import Array, Bool, Float, Int, Ints, Mask
from estbench.spaces.linalg import surely_finite
from estbench.spaces.manifold import product


class SensorSuite:
    """The channels of some rows.

    Args:
        model: compiled MuJoCo model that holds the sensors.
        backend: computes the true readings of the rows.
        channels: sensors in use.
        rows: how many robots.
        last: tick of an episode after which no reading is due; None for no end.
        look: whether every episode begins with a look at all channels, kept in `latest`.

    Attributes:
        channels: sensors in use.
        space: the manifold of all channels' readings, one after the other.
        latest: the latest reading of every channel that arrived `(row, ny)`, 0 for a component
            that never had a return; only with `look`.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        backend: Backend,
        channels: Sequence[Channel],
        rows: int,
        last: int | None = None,
        look: bool = False,
    ):
        self.channels, self.space = tuple(channels), product([c.space for c in channels])
        self._model, self._backend, self._look = model, backend, look
        self._samplers = [Sampler(group, rows, last) for group in alike(channels)]
        stops = np.cumsum([0, *(c.space.nx for c in channels)]).tolist()
        self._points = {c.name: slice(a, b) for c, a, b in zip(channels, stops, stops[1:])}
        self._plans: dict[tuple[bool, ...], Plan] = {}
        self.latest = np.zeros((rows, self.space.nx))

    def start(
        self,
        rows: Int[Ints, " k"],
        seed: Seeds,
        runs: Sequence[int],
        tick: int,
        x: Float[Array, "row nx"],
        u: Float[Array, "row nu"],
    ) -> None:
        """Begin episodes in some rows.

        Args:
            rows: their numbers.
            seed: of all of them, or one for each.
            runs: the number of the run in each.
            tick: now.
            x: true states of all rows `(row, nx)`.
            u: controls `(row, nu)`.
        """
        for sampler in self._samplers:
            sampler.start(rows, seed, runs, tick)
        if not self._look:
            return
        clean = self.clean(self.channels, 0.0, x, u)[rows]
        for channel in self.channels:
            # A look of its own: a filter's first measurement comes one period after the start.
            point, width = self._points[channel.name], channel.space.n
            white = streams.normals(seed, runs, f"sensor:{channel.name}:look", 1, width)[0]
            y = channel.space.plus(clean[:, point], channel.noise_from(white, 0.0))
            self.latest[rows, point] = np.where(np.isinf(y), 0.0, y)

    def read(
        self,
        tick: int,
        t: float | Float[Array, "row 1"],
        x: Float[Array, "row nx"],
        u: Float[Array, "row nu"],
        moved: Bool[Mask, " row"] | None = None,
        force: Float[Array, "row nv"] | None = None,
    ) -> list[Delivery]:
        """Take the readings that are due, and hand out those that arrive.

        Args:
            tick: now.
            t: time since the episode began, s; `(row, 1)` where the rows differ.
            x: true states `(row, nx)`.
            u: controls `(row, nu)`.
            moved: rows for which time has passed `(row,)`; None is all.
            force: generalized forces that the sensors see; None for none.
        """
        takes = tuple([sampler.takes(tick) for sampler in self._samplers])
        y = None
        if any(takes):
            if takes not in self._plans:
                due = [s.channels for s, now in zip(self._samplers, takes) if now]
                self._plans[takes] = self._plan([c for channels in due for c in channels])
            y = self._read(self._plans[takes], t, x, u, force)
        out: list[Delivery] = []
        start = 0
        for sampler, now in zip(self._samplers, takes):
            clean = None
            if y is not None and now:
                stop = start + sampler.width
                clean, start = y[:, start:stop], stop
            out += sampler.at(tick, clean, moved)
        if self._look:
            for delivery in divided(out):
                self._note(delivery)
        return out

    def clean(
        self,
        channels: Sequence[Channel],
        t: float | Float[Array, "row 1"],
        x: Float[Array, "row nx"],
        u: Float[Array, "row nu"],
    ) -> Float[Array, "row ny"]:
        """Noise-free readings `(row, ny)` of some channels, +inf where there is no return."""
        return self._read(self._plan(channels), t, x, u)

    def _plan(self, channels: Sequence[Channel]) -> Plan:
        return Plan(self._model, [c.measurand for c in channels])

    def _read(
        self, plan: Plan, t: float | Array, x: Array, u: Array, force: Array | None = None
    ) -> Array:
        """Noise-free readings `(row, ny)` of the channels of a plan."""
        if plan.timed and not isinstance(t, float):  # a user's function is given one time
            out = np.empty((len(x), plan.space.nx))
            for now in np.unique(t):
                here = t[:, 0] == now
                out[here] = plan.read(self._backend, x, u, float(now), force)[here]
            return out
        return plan.read(self._backend, x, u, t, force)

    def _note(self, delivery: Delivery) -> None:
        point, y = self._points[delivery.channels[0]], delivery.y
        if not surely_finite(y):  # a component without a return keeps its last value
            y = np.where(np.isinf(y), self.latest[:, point], y)
        if delivery.mask is None:
            self.latest[:, point] = y
        else:
            self.latest[delivery.mask, point] = y[delivery.mask]
