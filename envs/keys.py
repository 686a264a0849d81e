"""Random numbers of environments: a 64-bit key an episode, and noise that depends on nothing else.

Every row draws a key from its own generator when an episode starts. Whatever is random in the
episode is a hash of (key, step, purpose), so that a row behaves the same alone and among 256.
"""

import zlib
from collections.abc import Callable, Iterable, Mapping

import numpy as np
from gymnasium.utils import seeding

from estbench.randomness import counter as random
from estbench.shapes import Array, Keys, Mask


def purpose(word: str) -> int:
    """The number of a purpose such as `"process"` or `"sensor:gyro"`."""
    return zlib.crc32(word.encode())


def draw_key(generator: np.random.Generator) -> np.uint64:
    """A new key; it advances the generator by one number."""
    return np.uint64(generator.integers(2**63))


class RowKeys:
    """A generator a row, seeded as Gymnasium seeds vector environments: row i from seed + i.

    Args:
        rows: how many.
        branch: which of the independent streams of a seed; None is that of `Env.np_random`.
    """

    def __init__(self, rows: int, branch: str | None = None):
        self._spawn = () if branch is None else (purpose(branch),)
        self._generators: list[np.random.Generator | None] = [None] * rows

    def seed(self, row: int, seed: int | None) -> None:
        """Seed a row; None takes fresh entropy, but only if the row has none yet."""
        if seed is None and self._generators[row] is not None:
            return
        if self._spawn:
            sequence = np.random.SeedSequence(seed, spawn_key=self._spawn)
            self._generators[row] = np.random.Generator(np.random.PCG64(sequence))
        else:
            self._generators[row] = seeding.np_random(seed)[0]

    def draw(self, rows: Iterable[int]) -> Keys:
        """New keys `(len(rows),)` of some rows."""
        keys = []
        for row in rows:
            self.seed(row, None)
            generator = self._generators[row]
            assert generator is not None
            keys.append(draw_key(generator))
        return np.array(keys, np.uint64)


class RowNoise:
    """Random numbers `(row, width)` step by step; each row counts its own steps.

    They are made `BLOCK` steps at a time: a hash of a few numbers costs as much as one of many.

    Args:
        rows: how many.
        parts: purpose -> width; the parts stand side by side, each with numbers of its own.
        kind: `random.normal` (standard normals) or `random.uniform` (on (0, 1)).
    """

    BLOCK = 32

    def __init__(
        self, rows: int, parts: Mapping[str, int], kind: Callable[..., Array] = random.normal
    ):
        self._kind = kind
        self._parts = [(purpose(word), width) for word, width in parts.items() if width]
        self._keys = np.zeros(rows, np.uint64)
        self._step = np.zeros(rows, np.int64)
        self._together: int | None = None
        self._every = np.arange(rows)
        self._block = np.zeros((rows, self.BLOCK, sum(parts.values())))

    def start(self, mask: Mask, keys: Keys) -> None:
        """Begin an episode in the rows of a mask, with keys `(mask.sum(),)`."""
        if self._together is not None:
            self._step[:] = self._together
        self._keys[mask] = keys
        self._step[mask] = 0
        self._together = 0 if mask.all() else None
        self._fill(mask)

    def draw(self, mask: Mask | None = None) -> Array:
        """The next numbers `(row, width)`; only the rows of the mask move on."""
        if mask is None and self._together is not None:
            return self._draw_together(self._together)
        if self._together is not None:
            self._step[:], self._together = self._together, None
        place = self._step % self.BLOCK
        out = self._block[self._every, place]
        self._step += 1 if mask is None else mask
        spent = place == self.BLOCK - 1
        if mask is not None:
            spent &= mask
        if spent.any():
            self._fill(spent)
        return out

    def _draw_together(self, step: int) -> Array:
        """As `draw` while all rows are at the same step: the usual case costs next to nothing."""
        out = self._block[:, step % self.BLOCK].copy()
        self._together = step + 1
        if self._together % self.BLOCK == 0:
            self._step[:] = self._together
            self._fill(np.ones(len(self._step), bool))
        return out

    def _fill(self, mask: Mask) -> None:
        count = (self._step[mask] // self.BLOCK).astype(np.uint64)
        start = 0
        for number, width in self._parts:
            stop = start + width
            self._block[mask, :, start:stop] = self._kind(
                self._keys[mask], count, number, self.BLOCK, width
            )
            start = stop
