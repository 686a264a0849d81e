"""Beliefs, the estimator protocol, and the measurement update that every Gaussian filter shares."""

import inspect
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from estbench.errors import DimensionError
from estbench.linalg import cholesky, identity, pad_absent, solve_lower, surely_finite
from estbench.manifold import Manifold
from estbench.models.base import Channels

Array = NDArray[np.float64]


class Fault(IntEnum):
    """Why a run stopped being estimated; the value is stored a run, the text is for people."""

    NONE = 0
    STATE = 1
    COVARIANCE = 2
    INNOVATION = 3
    TRUTH = 4

    @property
    def text(self) -> str:
        """What failed, in words."""
        return (
            "",
            "the estimate is not finite",
            "the state covariance P is not positive definite",
            "the innovation covariance S is not positive definite",
            "the simulation of the truth failed",
        )[self]


@dataclass(frozen=True, eq=False)
class Gaussian:
    """A Gaussian belief: mean `(run, nx)`, covariance `(run, n, n)` in the tangent at the mean.

    A failed run has NaN in both and its `Fault` in `fault` `(run,)`; it stays failed.
    """

    mean: Array
    cov: Array
    fault: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Innovation:
    """What a measurement said: ν and S `(run, m)`, `(run, m, m)`.

    Attributes:
        residual: ν = y ⊖ ŷ; zero where nothing arrived.
        cov: S.
        white: L⁻¹ ν with S = L Lᵀ, standard normal for a consistent filter `(run, m)`.
        nis: νᵀ S⁻¹ ν `(run,)`.
        dof: how many components arrived `(run,)`.
    """

    residual: Array
    cov: Array
    white: Array
    nis: Array
    dof: NDArray[np.int64]


@runtime_checkable
class Estimator(Protocol):
    """The methods an estimator of any family has; no base class is needed.

    It is built as `Class(model, **settings)`. Methods are pure: they return new beliefs.
    """

    def init(self, mean: Array, cov: Array) -> Any:
        """The belief at the start from mean `(run, nx)` and covariance `(run, n, n)`."""
        ...

    def predict(self, belief: Any, u: Array, t: float, dt: float) -> Any:
        """The belief at t + dt, given the belief at t and the control `(run, nu)` held between."""
        ...

    def update(
        self,
        belief: Any,
        y: Array,
        u: Array,
        t: float,
        channels: Channels = None,
        mask: NDArray[np.bool_] | None = None,
    ) -> tuple[Any, Innovation]:
        """The belief given the measurement y `(run, ny)` of `channels` at t.

        `mask` `(run, m)` is True where a component has arrived; None means everywhere.
        """
        ...

    def mean(self, belief: Any) -> Array:
        """x̂ `(run, nx)`."""
        ...

    def cov(self, belief: Any) -> Array:
        """P `(run, n, n)` in the tangent at x̂."""
        ...


@dataclass(frozen=True, eq=False)
class Measurement:
    """What arrived at one instant: y `(run, ny)` under u `(run, nu)`, as in `update`."""

    y: Array
    u: Array
    channels: Channels = None
    mask: NDArray[np.bool_] | None = None


@dataclass(frozen=True, eq=False)
class Passage:
    """A filter's whole way through some runs, for a smoother to look back on.

    Attributes:
        beliefs: K + 1, the first at the start, the others after the updates.
        controls: K, each `(run, nu)`, held from one time to the next.
        times: K + 1, in s.
        measurements: K + 1 lists of what was fused at each time; the first is empty.
    """

    beliefs: list[Any]
    controls: list[Array]
    times: list[float]
    measurements: list[list[Measurement]]


@runtime_checkable
class Smoother(Estimator, Protocol):
    """An estimator that also looks back; its smoothed beliefs are the ones that are judged."""

    def smooth(self, passage: Passage) -> Sequence[Any]:
        """K + 1 beliefs, each given all measurements (or those of a window)."""
        ...


def check_prior(space: Manifold | None, mean: Array, cov: Array) -> None:
    """Refuse a prior that does not fit the state's manifold, where that is known.

    A covariance that is not positive semidefinite is no mistake here: its run is marked as failed.

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
    estimator: Estimator, mean: Array, cov: Array, keys: NDArray[np.uint64] | None = None
) -> Any:
    """The belief at the start; an estimator that draws random numbers gets a key `(run,)` each."""
    random = keys is not None and "keys" in inspect.signature(estimator.init).parameters
    return estimator.init(mean, cov, **({"keys": keys} if random else {}))


class GaussianEstimator:
    """Shared by the estimators whose belief is a `Gaussian`: init, mean and cov."""

    def init(self, mean: Array, cov: Array) -> Gaussian:
        """Start from mean `(run, nx)` and covariance `(run, n, n)`."""
        check_prior(getattr(getattr(self, "model", None), "space", None), mean, cov)
        return Gaussian(mean, cov, np.zeros(len(mean), np.uint8))

    def mean(self, belief: Gaussian) -> Array:
        """x̂ `(run, nx)`."""
        return belief.mean

    def cov(self, belief: Gaussian) -> Array:
        """P `(run, n, n)`."""
        return belief.cov


@dataclass(frozen=True, eq=False)
class Correction:
    """The linear estimate of the error from an innovation: δ = K ν.

    Its gain K and its reduction K S Kᵀ are products that few filters need both of.

    Attributes:
        delta: K ν `(run, n)`.
        innovation: ν, S and NIS.
        fault: `Fault.INNOVATION` where S has no Cholesky factor.
        white: W = L⁻¹ Pxyᵀ `(run, m, n)`, with S = L Lᵀ.
        whitening: L⁻¹ `(run, m, m)`.
    """

    delta: Array
    innovation: Innovation
    fault: NDArray[np.uint8]
    white: Array
    whitening: Array

    @cached_property
    def gain(self) -> Array:
        """K = Wᵀ L⁻¹ `(run, n, m)`."""
        return self.white.mT @ self.whitening

    @cached_property
    def reduction(self) -> Array:
        """K S Kᵀ = Wᵀ W `(run, n, n)`, what the update takes from P."""
        return self.white.mT @ self.white


def correct(
    residual: Array, S: Array, cross: Array, mask: NDArray[np.bool_] | None = None
) -> Correction:
    """Condition on an innovation: K = Pxy S⁻¹ by Cholesky (source 003, eq. 3-4; Bishop, eq. 20).

    With S = L Lᵀ and W = L⁻¹ Pxyᵀ: K ν = Wᵀ (L⁻¹ ν), NIS = |L⁻¹ ν|².
    A component that did not arrive is taken out exactly: its cross-covariance and residual are
    zero and its row and column of S are those of the identity.

    Args:
        residual: ν `(run, m)`.
        S: innovation covariance `(run, m, m)`, R included.
        cross: Pxy `(run, n, m)` (P Hᵀ for a linear measurement).
        mask: `(run, m)`, True where a component arrived.
    """
    m, n = S.shape[-1], cross.shape[-2]
    if mask is not None and not mask.all():
        S = pad_absent(S, mask)
        cross = np.where(mask[:, None, :], cross, 0.0)
        residual = np.where(mask, residual, 0.0)
        dof = mask.sum(axis=-1)
    else:
        dof = np.full(len(S), m)
    lower = cholesky(S)
    joint = np.zeros((len(S), m, n + 1 + m))
    joint[..., :n], joint[..., n], joint[..., n + 1 :] = cross.mT, residual, identity(m)
    joint = solve_lower(lower, joint)
    W, white = joint[..., :n], joint[..., n]
    delta = (W.mT @ white[..., None])[..., 0]
    nis = np.vecdot(white, white)
    fault = np.zeros(len(S), np.uint8)
    if not surely_finite(nis):
        factored = np.isfinite(lower[:, 0, 0])
        fault[~factored & np.isfinite(S).all(axis=(-2, -1))] = Fault.INNOVATION
    innovation = Innovation(residual, S, white, nis, dof)
    return Correction(delta, innovation, fault, W, joint[..., n + 1 :])


def settle(
    space: Manifold,
    prior: Gaussian,
    delta: Array,
    cov: Array,
    fault: NDArray[np.uint8] | None = None,
) -> Gaussian:
    """The posterior x̂⁻ ⊞ δ with its covariance carried to the new tangent; failures marked."""
    return marked(
        replace(prior, mean=space.plus(prior.mean, delta), cov=space.transport(cov, delta)), fault
    )


def marked(belief: Gaussian, fault: NDArray[np.uint8] | None = None) -> Gaussian:
    """The belief with every run that is not finite, or has a new `fault`, set to NaN and marked."""
    failed = np.count_nonzero(belief.fault) or (fault is not None and np.count_nonzero(fault))
    if not failed and surely_finite(belief.mean, belief.cov):
        return belief
    finite = np.isfinite(belief.mean).all(axis=-1) & np.isfinite(belief.cov).all(axis=(-2, -1))
    code = np.where(finite, Fault.NONE, Fault.STATE).astype(np.uint8)
    if fault is not None:
        code = np.where(fault, fault, code)
    code = np.where(belief.fault, belief.fault, code)
    bad = code != Fault.NONE
    return replace(
        belief,
        mean=np.where(bad[:, None], np.nan, belief.mean),
        cov=np.where(bad[:, None, None], np.nan, belief.cov),
        fault=code,
    )
