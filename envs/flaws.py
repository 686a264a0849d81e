"""Noise and imperfections of channels on many robots, each at its own time since its reset."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
from scipy.linalg import block_diag

from estbench.envs.keys import Keys, Mask, RowNoise, purpose
from estbench.envs.merge import select
from estbench.randomness import counter as random
from estbench.sensors.channel import Channel
from estbench.sensors.imperfections import Draws, State, deliver, start
from estbench.shapes import Array
from estbench.spaces.manifold import Manifold


class Source(Protocol):
    """What one or several channels do to their true readings `(row, ny)`."""

    def start(self, mask: Mask, keys: Keys, clean: Array) -> None:
        """Switch the sensors on in the rows of a mask, with random keys `(mask.sum(),)`."""
        ...

    def read(
        self, clean: Array, time: Array, due: Mask | None, keep: bool = True
    ) -> tuple[Array, Mask | None]:
        """A reading of all rows.

        Args:
            clean: noise-free readings `(row, ny)`.
            time: since each row's reset `(row,)`, s.
            due: rows that take it; None is all.
            keep: whether it changes the sensors' memory.

        Returns:
            Readings `(row, ny)` and where they arrive `(row,)` (None: in all rows that take it).
        """
        ...


class White:
    """Channels with constant white noise only, which deliver together.

    Args:
        channels: the sensors.
        space: the manifold of their readings, one after the other.
        rows: how many robots.
        quiet: names of channels that have no noise, whatever R is believed.
    """

    def __init__(
        self, channels: Sequence[Channel], space: Manifold, rows: int, quiet: frozenset[str]
    ):
        self._space = space
        self._noise = RowNoise(rows, {f"sensor:{c.name}": c.space.n for c in channels})
        factors = [np.linalg.cholesky(c.cov) * (c.name not in quiet) for c in channels]
        self._factor = np.asarray(block_diag(*factors), np.float64)
        diagonal = np.diagonal(self._factor)
        self._std = diagonal.copy() if (self._factor == np.diag(diagonal)).all() else None

    def start(self, mask: Mask, keys: Keys, clean: Array) -> None:
        """As `Source.start`."""
        self._noise.start(mask, keys)

    def read(
        self, clean: Array, time: Array, due: Mask | None, keep: bool = True
    ) -> tuple[Array, Mask | None]:
        """As `Source.read`."""
        white = self._noise.draw(due)
        if self._std is not None:
            return self._space.plus(clean, self._std * white), None
        # A stack of small products: one large product would depend on the count of rows.
        return self._space.plus(clean, (self._factor @ white[..., None])[..., 0]), None


class Flawed:
    """One channel with imperfections or a schedule of its noise; see `sensors.imperfections`.

    Args:
        channel: the sensor.
        rows: how many robots.
        quiet: whether it has no white noise, whatever R is believed.
    """

    def __init__(self, channel: Channel, rows: int, quiet: bool = False):
        self.channel, self._rows = channel, rows
        self._quiet = quiet
        word, imperfections = f"sensor:{channel.name}", channel.imperfections
        self._white = RowNoise(rows, {word: channel.space.n})
        normals: dict[str, int] = {}
        uniforms: dict[str, int] = {}
        if imperfections is not None:
            normals = imperfections.normals(channel.space.n)
            uniforms = imperfections.uniforms()
        self._draws = [
            (named, RowNoise(rows, {f"{word}:{k}": w for k, w in named.items()}, kind))
            for named, kind in ((normals, random.normal), (uniforms, random.uniform))
            if named
        ]
        self._state: State | None = None

    def start(self, mask: Mask, keys: Keys, clean: Array) -> None:
        """As `Source.start`; constants such as a bias are drawn."""
        self._white.start(mask, keys)
        for _, noise in self._draws:
            noise.start(mask, keys)
        imperfections, m = self.channel.imperfections, self.channel.space.n
        if imperfections is None:
            return
        draws, zero = {}, np.zeros(len(keys), np.uint64)
        for name, width in imperfections.constants(m).items():
            draws[name] = np.zeros((self._rows, width))
            number = purpose(f"sensor:{self.channel.name}:{name}")
            draws[name][mask] = random.normal(keys, zero, number, width)
        fresh = start(imperfections, draws, self._rows, m)
        # A row keeps its own time; `deliver` takes it as it takes a number.
        last = clean if imperfections.stuck else None
        fresh = replace(fresh, time=np.zeros((self._rows, 1)), last=last)
        self._state = fresh if self._state is None else select(mask, fresh, self._state, "sensor")

    def read(
        self, clean: Array, time: Array, due: Mask | None, keep: bool = True
    ) -> tuple[Array, Mask | None]:
        """As `Source.read`."""
        channel = self.channel
        white = self._white.draw(due) * (not self._quiet)
        noise = channel.noise_from(white, 0.0) if channel.schedule is None else np.empty_like(white)
        if channel.schedule is not None:  # a row has its own time, most have the same
            for t in np.unique(time):
                rows = time == t
                noise[rows] = channel.noise_from(white[rows], float(t))
        if channel.imperfections is None or self._state is None:
            return channel.space.plus(clean, noise), None
        draws: Draws = {}
        for named, source in self._draws:
            values, first = source.draw(due), 0
            for name, width in named.items():
                draws[name] = values[:, first : first + width]
                first += width
        y, arrives, state = deliver(
            channel.imperfections, channel.space, clean, noise, self._state, draws,
            time[:, None],  # pyright: ignore[reportArgumentType]
        )  # fmt: skip
        if keep:
            self._state = state if due is None else select(due, state, self._state, "sensor")
        return y, arrives
