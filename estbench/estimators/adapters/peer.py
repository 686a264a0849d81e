"""Base of the adapters: a filter of another library handles one run, so runs are done in turn."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estbench.errors import EstimatorError
from estbench.estimators.beliefs import Fault, Gaussian, GaussianEstimator
from estbench.estimators.protocol import Innovation
from estbench.estimators.update import mark_failed
from estbench.models.protocol import Channels, Model
from estbench.shapes import Array, Bool, Float, Mask
from estbench.spaces.linalg import cholesky, solve_lower

Moments = tuple[Array, Array]
"""Mean `(n,)` and covariance `(n, n)` of one run."""


@dataclass(frozen=True, eq=False)
class OneRun:
    """The model for one run at one time.

    Attributes:
        model: the model of all runs.
        index: number of the run, for noise that differs between runs.
        u: control of the run `(1, nu)`.
        t: time, s.
        dt: interval to the next time, s; 0 for an update.
        channels: channels of the measurement.
        arrived: mask `(m,)` of the components that arrived; None for all.
        predicted: measurement at the mean, finite where `arrived`; it takes the place of a
            component without a return at another state.
    """

    model: Model
    index: int
    u: Array
    t: float
    dt: float = 0.0
    channels: Channels = None
    arrived: NDArray[np.bool_] | None = None
    predicted: Array | None = None

    def f(self, points: Float[Array, "point n"]) -> Float[Array, "point n"]:
        """The states after dt."""
        return self.model.transition(points[None], self.u, self.t, self.dt)[0]

    def f_jacobian(self, x: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
        """State and Φ after dt."""
        moved, F = self.model.transition_jacobian(x[None], self.u, self.t, self.dt)
        return moved[0], F[0]

    def process_noise(self, x: Float[Array, " n"]) -> Float[Array, "n n"]:
        """Q at x."""
        Q = self.model.process_noise(x[None], self.u, self.t, self.dt)
        return Q[0] if Q.ndim == 3 else Q

    def h(self, points: Float[Array, "point n"]) -> Float[Array, "point m"]:
        """The measurements at the states."""
        y = self.model.measurement(points[None], self.u, self.t, self.channels)[0]
        return self._kept(self._finite(y))

    def h_jacobian(self, x: Float[Array, " n"]) -> tuple[Float[Array, " m"], Float[Array, "m n"]]:
        """Measurement and H."""
        y, H = self.model.measurement_jacobian(x[None], self.u, self.t, self.channels)
        return self._kept(self._finite(y[0])), self._kept(H[0].T).T

    def measurement_noise(self) -> Float[Array, "m m"]:
        """R."""
        R = self.model.measurement_noise(self.t, self.channels)
        R = R[self.index] if R.ndim == 3 else R
        return self._kept(self._kept(R).T).T

    def _finite(self, y: Array) -> Array:
        return y if self.predicted is None else np.where(np.isinf(y), self.predicted, y)

    def _kept(self, columns: Array) -> Array:
        return columns if self.arrived is None else columns[..., self.arrived]


@dataclass(frozen=True)
class PeerFilter(GaussianEstimator):
    """Runs a filter of another library; a subclass predicts and updates one run.

    Attributes:
        model: the filter's model, whose state and measurements must be vectors.

    Raises:
        EstimatorError: the state or a measurement holds a quaternion or an angle.
        MissingExtraError: the library is not installed.
    """

    model: Model

    def __post_init__(self) -> None:
        for what, space in (("state", self.model.space), ("measurement", self.model.output())):
            if not space.vector:
                raise EstimatorError(
                    f"{type(self).__name__}: the {what} holds a quaternion or an angle and this "
                    "library knows vectors only; use 'ekf' or 'ukf', or leave that channel out"
                )
        self.load()

    def load(self) -> None:
        """Import the library."""
        raise NotImplementedError

    def predicted(self, x: Float[Array, " n"], P: Float[Array, "n n"], one: OneRun) -> Moments:
        """x̂⁻ and P⁻ of one run."""
        raise NotImplementedError

    def updated(
        self, x: Float[Array, " n"], P: Float[Array, "n n"], y: Float[Array, " m"], one: OneRun
    ) -> tuple[Float[Array, " n"], Float[Array, "n n"], Moments]:
        """x̂⁺, P⁺ and (ν, S) of one run."""
        raise NotImplementedError

    def predict(self, belief: Gaussian, u: Float[Array, "run nu"], t: float, dt: float) -> Gaussian:
        """The prediction of the library, run by run."""
        mean, cov = belief.mean.copy(), belief.cov.copy()
        fault = np.zeros(len(mean), np.uint8)
        for i in np.flatnonzero(belief.fault == 0):
            one = OneRun(self.model, int(i), u[i : i + 1], t, dt)
            try:
                mean[i], cov[i] = self.predicted(mean[i].copy(), cov[i].copy(), one)
            except np.linalg.LinAlgError:
                fault[i] = Fault.COVARIANCE
        return mark_failed(replace(belief, mean=mean, cov=cov), fault)

    def update(
        self,
        belief: Gaussian,
        y: Float[Array, "run ny"],
        u: Float[Array, "run nu"],
        t: float,
        channels: Channels = None,
        mask: Bool[Mask, "run m"] | None = None,
    ) -> tuple[Gaussian, Innovation]:
        """The update of the library, run by run; H and R hold only the components that arrived."""
        mean, cov = belief.mean.copy(), belief.cov.copy()
        runs, m = y.shape
        residual, S = np.zeros((runs, m)), np.tile(np.eye(m), (runs, 1, 1))
        predicted = self.model.measurement(mean, u, t, channels)
        present = ~np.isinf(predicted) & (True if mask is None else mask)
        fault = np.zeros(runs, np.uint8)
        for i in np.flatnonzero((belief.fault == 0) & present.any(axis=-1)):
            here = present[i]
            one = OneRun(self.model, int(i), u[i : i + 1], t, 0.0, channels, here, predicted[i])
            try:
                mean[i], cov[i], (residual[i, here], S[i][np.ix_(here, here)]) = self.updated(
                    mean[i].copy(), cov[i].copy(), y[i, here], one
                )
            except np.linalg.LinAlgError:
                fault[i] = Fault.INNOVATION
        lower = cholesky(S)
        white = solve_lower(lower, residual[..., None])[..., 0]
        nis, dof = (white**2).sum(axis=-1), present.sum(axis=-1)
        innovation = Innovation(residual, S, white, nis, dof, lower)
        return mark_failed(replace(belief, mean=mean, cov=cov), fault), innovation
