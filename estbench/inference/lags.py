"""Lag products of whitened innovations: what a white sequence has none of."""

from collections.abc import Mapping, Sequence

import numpy as np

from estbench.inference.run_subset import ALL, RunIndex
from estbench.shapes import Array, Bool, Float, Int, Ints, Mask

Noted = tuple[Sequence[str], Float[Array, "run m"], Bool[Mask, "run m"] | None]
"""Channels, ν̃ and mask of one update."""

LAGS = 10
"""How many lags, in arrivals."""
BLOCK = 64
"""Instants whose products are added up together. Which they are depends on nothing else, so that a
run's sums are the same, to the last bit, whatever shares its batch."""


def correlation(
    sums: Float[Array, "*any lag"], terms: Int[Ints, "*any lag"]
) -> Float[Array, "*any lag"]:
    """Correlation of each lag from 0; NaN for a lag without terms.

        ρₗ = (Sₗ/Nₗ) / (S₀/N₀)

    Innovations that are all k times as large have the same; their size is what NIS looks at.

    Args:
        sums: Sₗ, of the products ν̃ₖ·ν̃ₖ₋ₗ.
        terms: Nₗ, how many products of two numbers are in each.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = sums / terms
        return mean / mean[..., :1]


class Lags:
    """Sums of ν̃ₖ ν̃ₖ₋ₗ, l = 0 ... LAGS, over the arrivals of each component.

    ν̃ = L⁻¹ν with S = L Lᵀ. A component's past is what arrived of it in that run: neither other
    channels nor the other runs of a batch matter. Innovations are kept until they are settled.

    Args:
        runs: how many.
        widths: channel -> count of its components.
    """

    def __init__(self, runs: int, widths: Mapping[str, int]):
        self._runs, self._widths = runs, dict(widths)
        self._noted: dict[tuple[int, int], Noted] = {}
        self._settled = 0  # the first instant that is not added up
        self._sums = np.zeros((runs, LAGS + 1))
        # Of each channel: its last LAGS arrivals, how many there were, and NIS/m at instants.
        self._tails = {name: np.zeros((runs, m, LAGS)) for name, m in widths.items()}
        self._counts = {name: np.zeros((runs, m), np.int64) for name, m in widths.items()}
        self._means: dict[str, list[tuple[Ints, Array]]] = {name: [] for name in widths}

    def put(
        self,
        instant: int,
        layer: int,
        channels: Sequence[str],
        white: Float[Array, "run m"],
        mask: Bool[Mask, "run m"] | None = None,
        rows: RunIndex = ALL,
    ) -> None:
        """Note an innovation; a replay of the same instant replaces it.

        Args:
            instant: at which the reading belongs.
            layer: of the instant's updates.
            channels: that it consists of.
            white: ν̃, zero where nothing arrived.
            mask: True where a component arrived; None means everywhere.
            rows: the runs it is of; what was noted of the others stays.
        """
        if not isinstance(rows, slice):
            before = self._noted.get((instant, layer))
            white, mask = self._among_others(before, channels, white, mask, rows)
        self._noted[instant, layer] = (channels, white, mask)

    def settle(self, first: int) -> None:
        """Nothing more is noted of the instants before `first`: add their products up."""
        while first >= self._settled + BLOCK:
            self._add_up(self._settled + BLOCK)

    def _among_others(
        self,
        noted: Noted | None,
        channels: Sequence[str],
        white: Array,
        mask: Mask | None,
        rows: RunIndex,
    ) -> tuple[Array, Mask]:
        """The innovation of some runs beside what was noted, of no other channels, in the rest."""
        whites = np.zeros((self._runs, white.shape[-1]))
        masks = np.zeros(whites.shape, bool)
        if noted is not None:
            before, old, came = noted
            for name in before:
                here, there = self._columns(channels, name), self._columns(before, name)
                whites[:, here] = old[:, there]
                masks[:, here] = True if came is None else came[:, there]
        whites[rows], masks[rows] = white, True if mask is None else mask
        return whites, masks

    def _columns(self, channels: Sequence[str], name: str) -> slice:
        """Where a channel's components stand among those of some channels."""
        start = sum(self._widths[c] for c in channels[: channels.index(name)])
        return slice(start, start + self._widths[name])

    @property
    def settled(self) -> int:
        """The first instant that is not added up."""
        return self._settled

    def sums(self, final: bool = True) -> tuple[Float[Array, "run lag"], Int[Ints, "run lag"]]:
        """The sums of lags 0 to LAGS, and how many products of two numbers are in each.

        Args:
            final: whether nothing is noted after it; else they are those of the settled instants.
        """
        if final:
            self._finish()
        terms = np.zeros((self._runs, LAGS + 1), np.int64)
        for count in self._counts.values():
            terms += np.maximum(count[..., None] - np.arange(LAGS + 1), 0).sum(axis=1)
        return self._sums, terms

    def nis(self, stop: int, first: int = 0) -> Float[Array, "step run channel"]:
        """NIS/m of each channel at each instant, NaN where nothing of it arrived.

        Of channels fused together it is the sum of ν̃² over the channel's components, divided by
        their number: NIS of the channel given those before it in the measurement, so that the sums
        of all channels add up to NIS.

        Args:
            stop: the first instant that is left out. Nothing may be noted of those before it.
            first: instant, before which all have been let go.
        """
        if stop > self._settled:
            self._finish()
        out = np.full((stop - first, self._runs, len(self._widths)), np.nan)
        for i, found in enumerate(self._means.values()):
            for instants, mean in found:
                out[instants - first, :, i] = mean
        return out

    def drop(self, first: int) -> None:
        """Let NIS of the instants before one go: all that has been added up."""
        for found in self._means.values():
            found[:] = [(instants, mean) for instants, mean in found if instants[-1] >= first]

    def _finish(self) -> None:
        while self._noted:
            self._add_up(self._settled + BLOCK)

    def _add_up(self, end: int) -> None:
        """Add the products of the innovations from the settled instants to `end`, and forget them.

        The last LAGS arrivals of each component go before those of the block.
        """
        keys = sorted(key for key in self._noted if key[0] < end)
        for name in self._widths:
            own = [key for key in keys if name in self._noted[key][0]]
            if not own:
                continue
            arrived, came = self._arrivals(name, own)
            instants = np.array([instant for instant, _ in own])
            self._means[name].append(_means(instants, arrived, came))
            white, count = self._in_order(arrived, came)
            width = -(-len(own) // BLOCK) * BLOCK  # the order of a sum depends on its length
            series = np.zeros((*count.shape, LAGS + width))
            series[..., :LAGS], series[..., LAGS : LAGS + len(own)] = self._tails[name], white
            for lag in range(LAGS + 1):
                behind = series[..., LAGS - lag : LAGS - lag + width]
                self._sums[:, lag] += (series[..., LAGS:] * behind).sum(axis=(-2, -1))
            last = count[..., None] + np.arange(LAGS)
            self._tails[name] = np.take_along_axis(series, last, axis=-1)
            self._counts[name] += count
        for key in keys:
            del self._noted[key]
        self._settled = end

    def _arrivals(
        self, name: str, keys: Sequence[tuple[int, int]]
    ) -> tuple[Float[Array, "arrival run m"], Bool[Mask, "arrival run m"]]:
        """ν̃ of a channel at some updates, and in which runs it arrived."""
        white = np.empty((len(keys), self._runs, self._widths[name]))
        came = np.ones(white.shape, bool)
        for i, key in enumerate(keys):
            channels, values, mask = self._noted[key]
            columns = self._columns(channels, name)
            white[i] = values[:, columns]
            if mask is not None:
                came[i] = mask[:, columns]
        return white, came

    @staticmethod
    def _in_order(
        white: Float[Array, "arrival run m"], came: Bool[Mask, "arrival run m"]
    ) -> tuple[Float[Array, "run m arrival"], Int[Ints, "run m"]]:
        """A channel's arrivals in order, zeros after the last, and how many."""
        # Time last, so that a run's sum does not depend on the other runs.
        white = np.ascontiguousarray(np.moveaxis(white, 0, -1))
        came = np.moveaxis(came, 0, -1)
        if not came.all():
            order = np.argsort(~came, axis=-1, kind="stable")
            white = np.take_along_axis(np.where(came, white, 0.0), order, axis=-1)
        return white, came.sum(axis=-1)


def _means(
    instants: Int[Ints, " arrival"],
    white: Float[Array, "arrival run m"],
    came: Bool[Mask, "arrival run m"],
) -> tuple[Int[Ints, " instant"], Float[Array, "instant run"]]:
    """The mean of ν̃² over the components that arrived at each instant; NaN where none did."""
    first = np.flatnonzero(np.diff(instants, prepend=-1))  # of each instant's updates
    squares = np.where(came, white**2, 0.0).sum(axis=-1)
    square, number = (np.add.reduceat(a, first) for a in (squares, came.sum(axis=-1)))
    mean = np.full(square.shape, np.nan)
    return instants[first], np.divide(square, number, out=mean, where=number > 0)
