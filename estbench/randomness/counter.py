"""Random numbers that depend on a run's key and counter only, never on how runs are batched.

A generator with a state would tie run i's numbers to the runs drawn before it. Here every number is
a hash of (key of the run, counter of the call, purpose, index), all rows at once in `uint64`.

Source: the output function of SplitMix64 (Steele, Lea & Flood 2014), used as a
counter-based generator in the sense of Salmon et al. 2011, "Parallel random numbers: as easy as 1,
2, 3": the stream of (key, counter, purpose) starts at a hash of the three.
"""

import numpy as np
from scipy.special import ndtri

from estbench.shapes import Array, Float, Keys, UInt
from estbench.spaces.linalg import cholesky
from estbench.spaces.semidefinite import eigen_root, psd_root

_STEP = np.uint64(0x9E3779B97F4A7C15)


def default_keys(runs: int) -> UInt[Keys, " run"]:
    """The keys 0, 1, ... of the runs."""
    return np.arange(runs, dtype=np.uint64)


def bits(
    keys: UInt[Keys, " run"], counter: UInt[Keys, " run"], purpose: int, count: int
) -> UInt[Keys, "run count"]:
    """Random 64-bit words, `count` of each run."""
    start = _mix(np.atleast_1d(np.asarray(keys, np.uint64)) + _STEP)
    start = _mix(start + np.asarray(counter, np.uint64) * _STEP)
    start = _mix(start + np.full(1, purpose + 1, np.uint64) * _STEP)
    return _mix(start[:, None] + np.arange(1, count + 1, dtype=np.uint64) * _STEP)


def uniform(
    keys: UInt[Keys, " run"], counter: UInt[Keys, " run"], purpose: int, *shape: int
) -> Float[Array, "run ..."]:
    """Uniforms in the open interval (0, 1), `(run, *shape)`, of 52 random bits each."""
    words = bits(keys, counter, purpose, int(np.prod(shape)))
    words >>= np.uint64(12)
    numbers = words.astype(np.float64)  # in place: temporaries cost more than sums
    numbers += 0.5
    numbers *= 2.0**-52
    return numbers.reshape(-1, *shape)


def normal(
    keys: UInt[Keys, " run"], counter: UInt[Keys, " run"], purpose: int, *shape: int
) -> Float[Array, "run ..."]:
    """Standard normals `(run, *shape)`, by inversion of the distribution function."""
    numbers = uniform(keys, counter, purpose, *shape)
    return ndtri(numbers, out=numbers)


def gaussian(
    keys: UInt[Keys, " run"],
    counter: UInt[Keys, " run"],
    purpose: int,
    cov: Float[Array, "n n"] | Float[Array, "run n n"],
    count: int,
) -> Float[Array, "run count n"]:
    """Samples of N(0, P), `count` of each run, for one P or one of each run, perhaps singular."""
    factor = square_root(cov if cov.ndim == 3 else cov[None])
    return normal(keys, counter, purpose, count, cov.shape[-1]) @ factor.mT


def square_root(cov: Float[Array, "run n n"]) -> Float[Array, "run n n"]:
    """S with S Sᵀ = P: Cholesky, or by eigenvalues where P is singular.

    NaN where P has a negative eigenvalue beyond rounding errors, see `psd_root`.
    """
    out = cholesky(cov)
    failed = ~np.isfinite(out[:, 0, 0]) & np.isfinite(cov).all(axis=(-2, -1))
    if failed.any():
        root, _ = eigen_root(cov[failed])
        out[failed] = np.where(np.isfinite(psd_root(cov[failed])), root, np.nan)
    return out


def _mix(z: Keys) -> Keys:
    """The finalizer of SplitMix64: a bijection of 64-bit words that scrambles every bit."""
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))
