"""The Gaussian belief, the faults of a run, and the start of an estimator."""

import inspect
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any, Self

import numpy as np

from estbench.errors import DimensionError
from estbench.estimators.protocol import Estimator
from estbench.randomness.counter import default_keys
from estbench.shapes import Array, Faults, Float, Keys, UInt
from estbench.spaces.manifold import Manifold


class Fault(IntEnum):
    """Why the estimate of a run failed; the value is stored per run, `text` is for messages."""

    NONE = 0
    STATE = 1
    COVARIANCE = 2
    INNOVATION = 3
    TRUTH = 4
    REFERENCE = 5
    ASYMMETRIC = 6
    NIS = 7
    WEIGHTS = 8

    @property
    def text(self) -> str:
        """Description of the fault."""
        return (
            "",
            "the estimate is not finite",
            "the state covariance P is not positive semidefinite",
            "the innovation covariance S is not positive definite",
            "the simulation of the truth failed",
            "the reference estimator, whose estimate the controller sees, failed",
            "the state covariance P is not symmetric",
            "NIS is not νᵀS⁻¹ν of the innovation ν and its covariance S, or not finite",
            "the weights of the particles have vanished: no more than n of them carry the belief; "
            "raise `size`, set `regularization` (0.5 to 1), or use enkf or ukf",
        )[self]


@dataclass(frozen=True, eq=False)
class Gaussian:
    """A Gaussian belief.

    A failed run has NaN in mean and cov; it stays failed.

    Attributes:
        mean: x̂.
        cov: P in the tangent at x̂.
        fault: `Fault` of each run.
    """

    mean: Float[Array, "run nx"]
    cov: Float[Array, "run n n"]
    fault: UInt[Faults, " run"]

    def moved(self, mean: Float[Array, "run nx"], cov: Float[Array, "run n n"]) -> Self:
        """The belief with another x̂ and P: `dataclasses.replace` at a third of its cost."""
        belief = object.__new__(type(self))
        vars(belief).update(vars(self), mean=mean, cov=cov)
        return belief


def check_prior(
    space: Manifold | None, mean: Float[Array, "run nx"], cov: Float[Array, "run n n"]
) -> None:
    """Refuse a prior that does not fit the manifold of the state, if that is known.

    A covariance that is not positive semidefinite is accepted: its run is marked as failed.

    Raises:
        DimensionError: mean is not `(run, nx)`, or cov not `(run, n, n)`.
    """
    nx, n = (mean.shape[-1], cov.shape[-1]) if space is None else (space.nx, space.n)
    if mean.shape != (len(mean), nx) or cov.shape != (len(mean), n, n):
        raise DimensionError(
            f"mean has shape {mean.shape} and cov {cov.shape}; expected (run, nx), (run, n, n) "
            f"with nx = {nx} and n = {n}"
        )


def start(
    estimator: Estimator,
    mean: Float[Array, "run nx"],
    cov: Float[Array, "run n n"],
    keys: UInt[Keys, " run"] | None = None,
) -> Any:
    """The belief at the start; `keys` are passed on if the `init` of the estimator takes them."""
    random = keys is not None and takes_keys(estimator)
    return estimator.init(mean, cov, **({"keys": keys} if random else {}))


def takes_keys(estimator: Estimator) -> bool:
    """Whether an estimator draws random numbers: its `init` takes a key of each run."""
    return "keys" in inspect.signature(estimator.init).parameters


def restart(
    estimator: Estimator, belief: Any, mean: Float[Array, "run nx"], cov: Float[Array, "run n n"]
) -> Any:
    """The belief N(mean, cov), whose random numbers go on where those of `belief` are."""
    started = start(estimator, mean, cov, getattr(belief, "keys", None))
    counter = getattr(belief, "counter", None)
    return started if counter is None else replace(started, counter=counter)


def random_start(
    runs: int, keys: UInt[Keys, " k"] | None
) -> tuple[UInt[Keys, " run"], UInt[Keys, " run"]]:
    """The keys of the runs, by default 0, 1, ..., and their counters at zero.

    Raises:
        DimensionError: there is not one key per run.
    """
    keys = default_keys(runs) if keys is None else checked_keys(keys, runs)
    return keys, np.zeros(runs, np.uint64)


def checked_keys(keys: object, runs: int) -> UInt[Keys, " run"]:
    """Random keys that were given.

    Raises:
        DimensionError: there is not one whole number per run.
    """
    found = np.asarray(keys)
    if found.dtype.kind not in "iu":
        raise DimensionError(f"keys has type {found.dtype}; give one whole number per run")
    if found.shape != (runs,):
        raise DimensionError(f"keys has shape {found.shape}; expected one per run, {(runs,)}")
    return found.astype(np.uint64)


class GaussianEstimator:
    """Base of the estimators whose belief is a `Gaussian`: init, mean and cov."""

    def init(self, mean: Float[Array, "run nx"], cov: Float[Array, "run n n"]) -> Gaussian:
        """Start from N(mean, cov)."""
        check_prior(getattr(getattr(self, "model", None), "space", None), mean, cov)
        return Gaussian(mean, cov, np.zeros(len(mean), np.uint8))

    def mean(self, belief: Gaussian) -> Float[Array, "run nx"]:
        """The estimate x̂."""
        return belief.mean

    def cov(self, belief: Gaussian) -> Float[Array, "run n n"]:
        """The covariance P."""
        return belief.cov
