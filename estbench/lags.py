"""Lag products of whitened innovations, summed while a filter runs."""

from collections import deque

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LAGS = 10
"""How many lags, in updates with the same channels."""


class Lags:
    """Sums of ν̃ₖ·ν̃ₖ₋ₗ, l = 0 ... LAGS, over the updates with the same channels, once final.

    ν̃ = L⁻¹ν with S = L Lᵀ. Updates with other channels have their own past. A component that did
    not arrive counts in neither the sum nor the number of terms.

    Attributes:
        sums: `(run, LAGS + 1)`.
        terms: how many products of two numbers are in each `(run, LAGS + 1)`.
    """

    def __init__(self, runs: int):
        self.sums = np.zeros((runs, LAGS + 1))
        self.terms = np.zeros((runs, LAGS + 1), np.int64)
        self._open: dict[tuple[int, int], tuple[tuple[str, ...], Array, Array | None]] = {}
        self._past: dict[tuple[str, ...], deque[tuple[Array, Array | None]]] = {}

    def put(
        self,
        instant: int,
        layer: int,
        channels: tuple[str, ...],
        white: Array,
        mask: NDArray[np.bool_] | None = None,
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
            past = self._past.setdefault(channels, deque(maxlen=LAGS + 1))
            past.appendleft((white, mask))
            count, m = len(past), white.shape[-1]
            if not m:
                continue
            products = (np.stack([w for w, _ in past]) * white).sum(axis=-1)
            self.sums[:, :count] += products.T
            if all(known is None for _, known in past):
                self.terms[:, :count] += m
            else:
                for lag, (_, known) in enumerate(past):
                    self.terms[:, lag] += _both(mask, known, white)

    def finish(self) -> tuple[Array, NDArray[np.int64]]:
        """Sums and terms of everything."""
        self.settle(np.iinfo(np.int64).max)
        return self.sums, self.terms


def _both(a: Array | None, b: Array | None, white: Array) -> NDArray[np.int64] | int:
    """Components that arrived at both times `(run,)`."""
    if a is None or b is None:
        known = a if b is None else b
        return white.shape[-1] if known is None else known.sum(axis=-1)
    return (np.asarray(a, bool) & np.asarray(b, bool)).sum(axis=-1)
