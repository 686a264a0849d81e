"""Random streams: one for each run and purpose, so that run i is the same however runs are batched.

A purpose is a word ("initial", "process", "sensor:gyro", ...). Adding a sensor, an estimator or a
worker changes no other stream: comparisons use common random numbers.
"""

import zlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def stream(seed: int, run: int, purpose: str) -> np.random.Generator:
    """The generator of one run and purpose, from a child of `SeedSequence(seed)`."""
    child = np.random.SeedSequence(seed, spawn_key=(run, zlib.crc32(purpose.encode())))
    return np.random.Generator(np.random.SFC64(child))


def normals(seed: int, runs: Sequence[int], purpose: str, steps: int, width: int) -> Array:
    """Standard normals `(steps, run, width)`, time-major; run i's come from its own stream.

    The first steps do not depend on how many follow.
    """
    out = np.empty((steps, len(runs), width))
    if out.size:
        for row, run in enumerate(
            runs
        ):  # a stream a run is what makes runs independent of batching
            out[:, row] = stream(seed, run, purpose).standard_normal((steps, width))
    return out


def uniforms(seed: int, runs: Sequence[int], purpose: str, steps: int, width: int) -> Array:
    """As `normals`, uniform on [0, 1)."""
    out = np.empty((steps, len(runs), width))
    for row, run in enumerate(runs):
        out[:, row] = stream(seed, run, purpose).random((steps, width))
    return out


def run_keys(seed: int, runs: Sequence[int], purpose: str) -> NDArray[np.uint64]:
    """A 64-bit key a run `(run,)`, for estimators that draw random numbers of their own."""
    word = zlib.crc32(purpose.encode())
    return np.array(
        [
            np.random.SeedSequence(seed, spawn_key=(run, word)).generate_state(1, np.uint64)[0]
            for run in runs
        ],
        dtype=np.uint64,
    )
