"""EKF that estimates its noise covariances from the innovations, or enlarges P⁻ by settings."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, cast

import numpy as np
from numpy.typing import NDArray

from estbench.errors import EstimatorError
from estbench.estimators.beliefs import Gaussian
from estbench.estimators.ekf import EKF
from estbench.estimators.linear import linear_update
from estbench.estimators.no_return import returned
from estbench.estimators.protocol import Innovation
from estbench.estimators.settings import in_range, one_of, whole
from estbench.estimators.update import correct, mark_failed
from estbench.models.protocol import Channels
from estbench.shapes import Array, Bool, Float, Mask
from estbench.spaces.linalg import cholesky, pad_absent, solve_lower, symmetrize
from estbench.spaces.patterns import expand

PerName = float | Sequence[float] | dict[str, float]


@dataclass(frozen=True, eq=False)
class AdaptiveBelief(Gaussian):
    """A Gaussian with the estimates of the noise.

    Attributes:
        variance: of each measurement coordinate's noise `(run, m)`, all channels; NaN until its
            first arrival.
        density: estimated Q over dt `(run, n, n)`; None until the first prediction.
        elapsed: time since the last measurement, s `(run,)`.
    """

    variance: Array
    density: Array | None
    elapsed: Array


@dataclass(frozen=True)
class AdaptiveEKF(EKF):
    """Adaptive EKF: R or Q follow the innovations; inflation, fading memory, pseudo-noise.

    R: the variance of each coordinate follows η² + (H P⁺ Hᵀ)ᵢᵢ with the residual η = y ⊖ h after
    the update, its correlations stay the model's. Q: it follows Q + K (ν νᵀ - S) Kᵀ, which is
    δ δᵀ + P⁺ - Φ P Φᵀ, made positive semidefinite. These are the residual- and innovation-based
    estimates of Mohamed & Schwarz 1999 (after Mehra 1972), averaged over a fading window: each new
    value has weight 1/window (Akhlaghi, Zhou & Huang 2017). An estimate converges in a few times
    window/g² arrivals, where g = R/S for R and g = H K for Q. With fewer measured coordinates than
    states the innovations do not determine Q: NIS becomes consistent, single entries of Q may be
        wrong.

    P⁻ = Υ (α² Φ P⁺ Φᵀ + Q + Q_pseudo dt) Υᵀ: pseudo-noise and Υ from source 002 ("fudge" terms), α
    the fading memory of Sorenson & Sacks 1971.

    Cost per step: the EKF's. Choose it where the noise level is unknown or drifts slowly; adapting
    R and Q together is not well determined, so prefer one of them. Inflation, fading and
    pseudo-noise are for overconfidence that has no other remedy.

    Attributes:
        model: the filter's model.
        covariance_update: `joseph` only.
        adapt: which covariances are estimated.
        window: length of the memory in arrivals, at least 2.
        inflation: Υ's diagonal, at least 1: a number, a list, or {coordinate pattern: factor}.
        fading: α, at least 1.
        pseudo_noise: diagonal of Q_pseudo, (unit)²/s, like `inflation`.
    """

    adapt: Literal["none", "R", "Q", "both"] = "R"
    window: int = 30
    inflation: PerName = 1.0
    fading: float = 1.0
    pseudo_noise: PerName = 0.0
    _upsilon: Array = field(init=False, repr=False)
    _pseudo: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        one_of(self, "covariance_update", ("joseph",))
        one_of(self, "adapt", ("none", "R", "Q", "both"))
        whole(self, "window", 2)
        in_range(self, "fading", 1.0)
        names = self.model.space.names
        for setting, least, attribute in (
            ("inflation", 1.0, "_upsilon"),
            ("pseudo_noise", 0.0, "_pseudo"),
        ):
            values = expand(getattr(self, setting), names, f"AdaptiveEKF: {setting}", least)
            if not ((values >= least) & np.isfinite(values)).all():
                raise EstimatorError(
                    f"AdaptiveEKF: {setting} is {getattr(self, setting)!r}; use numbers of at "
                    f"least {least:g}"
                )
            object.__setattr__(self, attribute, values)

    def check_schedule(self, duration: float, arrivals: int, given: Collection[str]) -> None:
        """Refuse a window that is longer than the run; the default may be longer.

        Raises:
            EstimatorError: the window is given and exceeds the arrivals of a run.
        """
        if "window" in given and self.window > arrivals:
            raise EstimatorError(
                f"window is {self.window} arrivals but the run has {arrivals}; shorten it"
            )

    def init(self, mean: Float[Array, "run nx"], cov: Float[Array, "run n n"]) -> AdaptiveBelief:
        """Start from mean `(run, nx)` and cov `(run, n, n)` with the model's own noise."""
        start, runs = super().init(mean, cov), len(mean)
        variance = np.full((runs, self.model.output().n), np.nan)
        return AdaptiveBelief(start.mean, start.cov, start.fault, variance, None, np.zeros(runs))

    def predict(
        self, belief: Gaussian, u: Float[Array, "run nu"], t: float, dt: float
    ) -> AdaptiveBelief:
        """x̂⁻ = f(x̂⁺, u), P⁻ = Υ (α² Φ P⁺ Φᵀ + Q + Q_pseudo dt) Υᵀ."""
        prior = cast(AdaptiveBelief, belief)
        mean, F = self.model.transition_jacobian(prior.mean, u, t, dt)
        if prior.density is not None and self.adapt in ("Q", "both"):
            density = prior.density
        else:
            Q = np.asarray(self.model.process_noise(prior.mean, u, t, dt))
            density = np.broadcast_to(Q / dt, prior.cov.shape)
        cov = self.fading**2 * (F @ prior.cov @ F.mT)
        cov = symmetrize(cov + (density + np.diag(self._pseudo)) * dt)
        cov = cov * (self._upsilon[:, None] * self._upsilon)
        elapsed = prior.elapsed + dt
        prior = replace(prior, mean=mean, cov=cov, density=density, elapsed=elapsed)
        return cast(AdaptiveBelief, mark_failed(prior))

    def update(
        self,
        belief: Gaussian,
        y: Float[Array, "run ny"],
        u: Float[Array, "run nu"],
        t: float,
        channels: Channels = None,
        mask: Bool[Mask, "run m"] | None = None,
    ) -> tuple[AdaptiveBelief, Innovation]:
        """The update of the EKF with the estimated R, then the new estimates of R and Q."""
        space, output = self.model.space, self.model.output(channels)
        prior = cast(AdaptiveBelief, belief)
        predicted, H = self.model.measurement_jacobian(prior.mean, u, t, channels)
        residual, shape = output.minus(y, predicted), (len(y), output.n, output.n)
        mask = returned(residual, mask)
        R = np.broadcast_to(self.model.measurement_noise(t, channels), shape)
        everything = self.model.output().names
        columns = [everything.index(name) for name in output.names]
        R = self._adapted(R, prior.variance[:, columns])
        present = np.ones(shape[:2], bool) if mask is None else mask
        PHt = prior.cov @ H.mT
        c = correct(residual, symmetrize(H @ PHt + R), PHt, mask)
        posterior, innovation = linear_update(space, prior, residual, H, R, mask)
        if self.adapt in ("R", "both"):
            seen = self._seen_variance(R, innovation, present)
            variance = prior.variance.copy()
            variance[:, columns] = np.where(present, seen, variance[:, columns])
            posterior = replace(posterior, variance=variance)
        arrived = np.any(present, axis=-1, keepdims=True)[:, 0]
        if self.adapt in ("Q", "both") and prior.density is not None:
            # Of several updates at one instant only the first depends on Q.
            learn = arrived & (prior.elapsed > 0)
            surprise = c.delta[..., None] * c.delta[:, None] - c.reduction
            step = surprise / (self.window * np.where(learn, prior.elapsed, 1.0)[:, None, None])
            density = np.where(learn[:, None, None], _psd(prior.density + step), prior.density)
            posterior = replace(posterior, density=density)
        elapsed = np.where(arrived, 0.0, prior.elapsed)
        return replace(posterior, elapsed=elapsed), innovation

    def _adapted(self, R: Array, variance: Array) -> Array:
        """R with the estimated variances and unchanged correlations."""
        nominal = np.diagonal(R, axis1=-2, axis2=-1)
        scale = np.sqrt(np.where(np.isfinite(variance), variance, nominal) / nominal)
        return R * scale[:, :, None] * scale[:, None, :]

    def _seen_variance(self, R: Array, innovation: Innovation, present: NDArray[np.bool_]) -> Array:
        """Each variance moved by 1/window towards η² + (H P⁺ Hᵀ)ᵢᵢ `(run, m)`.

        With the R and S of the update, η = R S⁻¹ ν and H P⁺ Hᵀ = R - R S⁻¹ R.
        """
        R = pad_absent(R, present)
        half = solve_lower(cholesky(innovation.cov), R)  # L⁻¹ R
        eta = np.einsum("rij,ri->rj", half, innovation.white)
        old = np.diagonal(R, axis1=-2, axis2=-1)
        return old + (eta**2 - (half**2).sum(axis=-2)) / self.window


def _psd(matrices: Array) -> Array:
    """The nearest positive semidefinite matrices; a failed run is not changed."""
    good = np.isfinite(matrices).all(axis=(-2, -1))
    out = matrices.copy()
    values, vectors = np.linalg.eigh(symmetrize(matrices[good]))
    clipped = vectors * np.clip(values, 0.0, None)[:, None]
    out[good] = clipped @ vectors.mT
    return out
