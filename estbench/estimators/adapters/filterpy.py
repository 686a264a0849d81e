"""FilterPy's filters (Labbe, github.com/rlabbe/filterpy), for comparison; extra `peers`."""

import importlib
from dataclasses import dataclass
from typing import Any

from estbench.errors import MissingExtraError
from estbench.estimators.adapters.peer import Moments, OneRun, PeerFilter
from estbench.estimators.settings import scaled_rule
from estbench.shapes import Array, Float


@dataclass(frozen=True)
class _FilterPy(PeerFilter):
    """Base of the adapters for FilterPy."""

    def load(self) -> None:
        """Import FilterPy."""
        kalman()


@dataclass(frozen=True)
class FilterPyEKF(_FilterPy):
    """FilterPy's `ExtendedKalmanFilter`; it equals `ekf` up to rounding.

    Cost per step: that of the EKF, run by run in Python. Choose it to check either library.

    Attributes:
        model: the filter's model, of vectors only.
    """

    def predicted(self, x: Float[Array, " n"], P: Float[Array, "n n"], one: OneRun) -> Moments:
        """`predict` with `predict_x` replaced by the model's f, as FilterPy's manual says."""
        moved, F = one.f_jacobian(x)
        peer = kalman().ExtendedKalmanFilter(len(x), 1)
        peer.x, peer.P, peer.F, peer.Q = x, P, F, one.process_noise(x)
        peer.predict_x = lambda u=0: setattr(peer, "x", moved)
        peer.predict()
        return peer.x, peer.P

    def updated(
        self, x: Float[Array, " n"], P: Float[Array, "n n"], y: Float[Array, " m"], one: OneRun
    ) -> tuple[Float[Array, " n"], Float[Array, "n n"], Moments]:
        """`update` with h and H from the model."""
        predicted, H = one.h_jacobian(x)
        peer = kalman().ExtendedKalmanFilter(len(x), len(y))
        peer.x, peer.P = x, P
        peer.update(y, lambda x: H, lambda x: predicted, R=one.measurement_noise())
        return peer.x, peer.P, (peer.y, peer.S)


@dataclass(frozen=True)
class FilterPyUKF(_FilterPy):
    """FilterPy's `UnscentedKalmanFilter` (2.0 redraws its points); it equals `ukf` up to rounding.

    Cost per step: that of the UKF, point by point in Python. Choose it to check either library.

    Attributes:
        model: the filter's model, of vectors only.
        alpha, beta, kappa: of `MerweScaledSigmaPoints`, as in `UKF`.
    """

    alpha: float = 1.0
    beta: float = 2.0
    kappa: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        scaled_rule(self)

    def predicted(self, x: Float[Array, " n"], P: Float[Array, "n n"], one: OneRun) -> Moments:
        """`predict` with the model's f."""
        peer = self._peer(x, P, one, 1)
        peer.Q = one.process_noise(x)
        peer.predict()
        return peer.x, peer.P

    def updated(
        self, x: Float[Array, " n"], P: Float[Array, "n n"], y: Float[Array, " m"], one: OneRun
    ) -> tuple[Float[Array, " n"], Float[Array, "n n"], Moments]:
        """`update` with the model's h, from points drawn anew from x̂⁻ and P⁻."""
        peer = self._peer(x, P, one, len(y))
        peer.sigmas_f = peer.points_fn.sigma_points(x, P)
        peer.update(y, R=one.measurement_noise())
        return peer.x, peer.P, (peer.y, peer.S)

    def _peer(self, x: Array, P: Array, one: OneRun, m: int) -> Any:
        library = kalman()
        points = library.MerweScaledSigmaPoints(len(x), self.alpha, self.beta, self.kappa)
        peer = library.UnscentedKalmanFilter(
            len(x), m, one.dt, lambda x: one.h(x[None])[0], lambda x, dt: one.f(x[None])[0], points
        )
        peer.x, peer.P = x, P
        return peer


def kalman() -> Any:
    """The module `filterpy.kalman`.

    Raises:
        MissingExtraError: FilterPy is not installed.
    """
    try:
        return importlib.import_module("filterpy.kalman")
    except ImportError:
        raise MissingExtraError("filterpy", "peers") from None
