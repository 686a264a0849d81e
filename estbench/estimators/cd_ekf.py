"""Continuous-discrete extended Kalman filter (Bishop, eq. 4-11, 17-21)."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.integrate import RK45

from estbench.errors import EstimatorError
from estbench.estimators.beliefs import Gaussian
from estbench.estimators.ekf import EKF
from estbench.estimators.linear import predicted_cov
from estbench.estimators.settings import in_range, one_of, whole
from estbench.estimators.update import mark_failed
from estbench.models.continuous import ContinuousModel, integrate_moments, moment_rates
from estbench.shapes import Array, Float
from estbench.spaces.linalg import symmetrize

MOST_STEPS = 1000
SHORTEST_STEP = 1e-6
"""Bounds of one prediction by `rk45`, the second relative to dt; a run that exceeds them fails."""


@dataclass(frozen=True)
class ContinuousDiscreteEKF(EKF):
    """Continuous-discrete EKF: x̂, Φ and Q̄ integrated together (Bishop, eq. 10-11).

    dx̂/dt = f(x̂) + G u, dΦ/dt = F Φ, dQ̄/dt = F Q̄ + Q̄ Fᵀ + Q_s, then P⁻ = Φ P⁺ Φᵀ + Q̄; the update
    is that of the EKF. On a manifold the tangent increment from the start of each RK4 substep is
    integrated.

    Cost per prediction: by RK4 4 `substeps` flow Jacobians, each of n + 1 flows with forward
    differences; by `rk45` 6 per step, and retries. Choose it for a model that is given by its
    differential equation and noise density, in particular with slow or asynchronous measurements.

    Attributes:
        model: a `ContinuousModel`.
        covariance_update: as in `EKF`.
        method: `rk4`, fixed substeps; or `rk45`, scipy's adaptive Dormand-Prince pair. All runs
            of a batch have the same steps, so the result of each run depends on the other runs
            within the tolerances.
        substeps: number of RK4 steps in one prediction.
        rtol, atol: tolerances of `rk45`, for each run.
    """

    model: ContinuousModel
    method: Literal["rk4", "rk45"] = "rk4"
    substeps: int = 1
    rtol: float = 1e-8
    atol: float = 1e-10

    def __post_init__(self) -> None:
        super().__post_init__()
        one_of(self, "method", ("rk4", "rk45"))
        whole(self, "substeps", 1, 1_000_000)
        in_range(self, "rtol", 1e-12, 1.0)
        in_range(self, "atol", 0.0, low_open=True)
        for name in ("flow", "flow_jacobian", "spectral_density"):
            if not callable(getattr(self.model, name, None)):
                raise EstimatorError(
                    f"ContinuousDiscreteEKF: {type(self.model).__name__} has no method '{name}'; "
                    f"use a continuous model (ContinuousFunctionModel) or the estimator 'ekf'"
                )

    def predict(self, belief: Gaussian, u: Float[Array, "run nu"], t: float, dt: float) -> Gaussian:
        """x̂⁻ = x̂(t + dt), P⁻ = Φ P⁺ Φᵀ + Q̄ (Bishop, eq. 11)."""
        if self.method == "rk4":
            mean, Phi, Q = integrate_moments(self.model, belief.mean, u, t, dt, self.substeps)
        else:
            mean, Phi, Q = self._adaptive(belief.mean, u, t, dt)
        cov = predicted_cov(Phi, belief.cov, Q)
        return mark_failed(belief.moved(mean, cov))

    def _adaptive(self, x: Array, u: Array, t: float, dt: float) -> tuple[Array, Array, Array]:
        """As `integrate_moments`, by scipy's RK45; NaN for the runs that it cannot integrate.

        One such run stops the batch, which is then halved until that run is alone.
        """
        runs, n = len(x), self.model.space.n
        finite = np.isfinite(x).all(axis=-1)
        if not finite.all():
            out = (
                np.full_like(x, np.nan),
                np.full((runs, n, n), np.nan),
                np.full((runs, n, n), np.nan),
            )
            if finite.any():
                for whole, part in zip(
                    out, self._adaptive(x[finite], u[finite], t, dt), strict=True
                ):
                    whole[finite] = part
            return out

        def unpacked(state: Array) -> list[Array]:
            delta, Phi, Q = np.split(state.reshape(runs, -1), [n, n + n * n], axis=-1)
            return [delta, Phi.reshape(runs, n, n), Q.reshape(runs, n, n)]

        def slope(s: float, state: Array) -> Array:
            rates = moment_rates(self.model, x, u, t + s, *unpacked(state))
            return np.concatenate([rate.reshape(runs, -1) for rate in rates], axis=-1).ravel()

        start = np.zeros((runs, n + 2 * n * n))
        start[:, n : n + n * n] = np.eye(n).ravel()
        # scipy bounds the rms error over all runs; dividing by sqrt(run) bounds it in each.
        share = np.sqrt(runs)
        with np.errstate(invalid="ignore", over="ignore"):
            solver = RK45(
                slope, 0.0, start.ravel(), dt, first_step=dt,
                rtol=max(self.rtol / share, 1e-13), atol=self.atol / share,
            )  # fmt: skip
            for _ in range(MOST_STEPS):
                solver.step()
                taken = solver.step_size or 0.0
                if solver.status != "running" or taken < SHORTEST_STEP * dt:
                    break
        if solver.status == "finished" and np.isfinite(solver.y).all():
            delta, Phi, Q = unpacked(solver.y)
            return self.model.space.plus(x, delta), Phi, symmetrize(Q)
        if runs == 1:
            lost = np.full((1, n, n), np.nan)
            return np.full_like(x, np.nan), lost, lost
        middle = runs // 2
        halves = [self._adaptive(x[s], u[s], t, dt) for s in (slice(middle), slice(middle, None))]
        mean, Phi, Q = (np.concatenate(pair) for pair in zip(*halves, strict=True))
        return mean, Phi, Q
