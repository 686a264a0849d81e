"""Random streams: one for each run and purpose, so that run i is the same however runs are batched.

A purpose is a word ("initial", "process", "sensor:gyro", ...). Adding a sensor, an estimator or a
worker changes no other stream: comparisons use common random numbers.
"""

import zlib
from collections.abc import Iterator, Sequence

import numpy as np

from estbench.randomness import seeding
from estbench.shapes import Array, Float, Keys, UInt

Seeds = int | Sequence[int]
"""The seed of all runs, or one for each."""
_FEW = 4
"""Runs up to which numpy's own seeding is faster than that of many together."""


def streams(seed: Seeds, runs: Sequence[int], purpose: str) -> Iterator[np.random.Generator]:
    """Each run's generator for a purpose: `SFC64(SeedSequence(seed, spawn_key=(run, word)))`.

    The word is the purpose's CRC-32.
    """
    word = zlib.crc32(purpose.encode())
    if not isinstance(seed, int) or len(runs) <= _FEW:
        seeds = [seed] * len(runs) if isinstance(seed, int) else seed
        for own, run in zip(seeds, runs):
            sequence = np.random.SeedSequence(own, spawn_key=(run, word))
            yield np.random.Generator(np.random.SFC64(sequence))
        return
    for words in seeding.words(seed, runs, word, 3):
        # numpy's stubs leave ISeedSequence out.
        bits = np.random.SFC64(seeding.Seed(words))  # pyright: ignore[reportArgumentType]
        yield np.random.Generator(bits)


def normals(
    seed: Seeds, runs: Sequence[int], purpose: str, steps: int, width: int
) -> Float[Array, "step run k"]:
    """Standard normals, time-major; run i's come from its own stream.

    The first steps do not depend on how many follow.
    """
    out = np.empty((steps, len(runs), width))
    if out.size:
        for row, own in enumerate(streams(seed, runs, purpose)):
            out[:, row] = own.standard_normal((steps, width))
    return out


def uniforms(
    seed: Seeds, runs: Sequence[int], purpose: str, steps: int, width: int
) -> Float[Array, "step run k"]:
    """As `normals`, uniform on [0, 1)."""
    out = np.empty((steps, len(runs), width))
    for row, own in enumerate(streams(seed, runs, purpose)):
        out[:, row] = own.random((steps, width))
    return out


def run_keys(seed: Seeds, runs: Sequence[int], purpose: str) -> UInt[Keys, " run"]:
    """One 64-bit key per run, for estimators that draw random numbers of their own."""
    word = zlib.crc32(purpose.encode())
    if isinstance(seed, int):
        return seeding.words(seed, runs, word, 1)[:, 0]
    keys = [seeding.words(own, [run], word, 1)[0, 0] for own, run in zip(seed, runs)]
    return np.array(keys, np.uint64)
