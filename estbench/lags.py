"""Lag products of whitened innovations, summed while a filter runs."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LAGS = 10
"""How many lags, in arrivals."""


class Lags:
    """Sums of ν̃ₖ ν̃ₖ₋ₗ, l = 0 ... LAGS, over the arrivals of each component, once final.

    ν̃ = L⁻¹ν with S = L Lᵀ. A component's past is what arrived of it in that run: neither other
    channels nor the other runs of a batch matter.

    Args:
        runs: how many.
        widths: channel -> count of its components.

    Attributes:
        sums: `(run, LAGS + 1)`.
        terms: how many products of two numbers are in each `(run, LAGS + 1)`.
    """

    def __init__(self, runs: int, widths: Mapping[str, int]):
        self.sums = np.zeros((runs, LAGS + 1))
        self.terms = np.zeros((runs, LAGS + 1), np.int64)
        ends = np.cumsum([0, *widths.values()])
        self._slots = {name: np.arange(a, b) for name, a, b in zip(widths, ends, ends[1:])}
        self._open: dict[tuple[int, int], tuple[Sequence[str], Array, Mask | None]] = {}
        self._past = np.zeros((LAGS + 1, runs, ends[-1]))
        self._known = np.zeros(self._past.shape, bool)

    def put(
        self,
        instant: int,
        layer: int,
        channels: Sequence[str],
        white: Array,
        mask: Mask | None = None,
    ) -> None:
        """Note an innovation; a replay of the same instant replaces it.

        Args:
            instant: at which the reading belongs.
            layer: of the instant's updates.
            channels: that it consists of.
            white: ν̃ `(run, m)`, zero where nothing arrived.
            mask: `(run, m)`, True where a component arrived; None means everywhere.
        """
        self._open[instant, layer] = (channels, white, mask)

    def settle(self, before: int) -> None:
        """Count the innovations of instants that no replay can change any more."""
        for key in sorted(k for k in self._open if k[0] < before):
            channels, white, mask = self._open.pop(key)
            columns = np.concatenate([self._slots[name] for name in channels])
            came = np.ones(white.shape, bool) if mask is None else mask
            past, known = self._past[:, :, columns], self._known[:, :, columns]
            now = np.concatenate([white[None], past[:-1]])
            both = np.concatenate([came[None], known[:-1]])
            if mask is not None:
                now, both = np.where(came, now, past), np.where(came, both, known)
            self._past[:, :, columns], self._known[:, :, columns] = now, both
            both = both & came
            self.sums += np.where(both, now * white, 0.0).sum(axis=-1).T
            self.terms += both.sum(axis=-1).T

    def finish(self) -> tuple[Array, NDArray[np.int64]]:
        """Sums and terms of everything."""
        self.settle(np.iinfo(np.int64).max)
        return self.sums, self.terms
