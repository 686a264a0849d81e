"""numpy's seed sequences for many runs at once: the same words at a tenth of the time.

`SeedSequence` costs 5 µs and a generator made from it 4 more. A run has one for each purpose, some
ten, which in a run of 200 steps of a cart-pole is a twentieth of everything.
"""

from collections.abc import Sequence

import numpy as np
from numpy.random.bit_generator import ISeedSequence
from numpy.typing import NDArray

from estbench.shapes import Keys, UInt

Words = NDArray[np.uint32]

# The constants of O'Neill's seed_seq_fe, which `SeedSequence` is and promises to stay.
_MIX, _DRAW = (0x43B0D7E5, 0x931E8875), (0x8B51F9DD, 0x58F38DED)
_LEFT, _RIGHT = np.uint32(0xCA01F9DD), np.uint32(0x4973F715)
_POOL = 4


def words(seed: int, runs: Sequence[int], purpose: int, count: int) -> UInt[Keys, "run count"]:
    """The state that `SeedSequence(seed, spawn_key=(run, purpose))` generates.

    The library mixes the seed into its pool; the two words of the key, and the output, are done
    here for all runs together.

    Source: M. E. O'Neill, "Developing a seed_seq alternative" (2015).

    Args:
        seed: at least 0.
        runs: numbers below 2³².
        purpose: a number below 2³².
        count: words per run.
    """
    pool = [np.full(len(runs), word) for word in np.random.SeedSequence(seed).pool]
    blocks = max(_POOL, -(-seed.bit_length() // 32))  # of 32 bits that have been mixed already
    start, factor = _MIX
    constant = start * pow(factor, _POOL * blocks, 2**32) % 2**32
    for key in (np.asarray(runs, np.uint32), np.full(len(runs), purpose, np.uint32)):
        for i in range(_POOL):
            hashed, constant = _hash(key, constant, factor)
            mixed = _LEFT * pool[i] - _RIGHT * hashed
            pool[i] = mixed ^ (mixed >> np.uint32(16))
    constant, factor = _DRAW
    out = np.empty((len(runs), 2 * count), np.uint32)
    for i in range(2 * count):
        out[:, i], constant = _hash(pool[i % _POOL], constant, factor)
    return out.astype("<u4", copy=False).view("<u8").astype(np.uint64, copy=False)


def _hash(value: Words, constant: int, factor: int) -> tuple[Words, int]:
    """The hashed words and the next constant."""
    following = constant * factor % 2**32
    value = (value ^ np.uint32(constant)) * np.uint32(following)
    return value ^ (value >> np.uint32(16)), following


class Seed(ISeedSequence):
    """Words made beforehand, as a bit generator asks for them."""

    def __init__(self, words: UInt[Keys, " count"]):
        self._words = words

    def generate_state(self, n_words: int, dtype: type = np.uint64) -> UInt[Keys, " k"]:  # type: ignore[override]
        """The first `n_words`."""
        return self._words[:n_words]
