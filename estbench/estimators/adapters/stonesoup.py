"""Stone Soup's filters (Dstl, github.com/dstl/Stone-Soup), for comparison; extra `peers`."""

import importlib
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np

from estbench.errors import MissingExtraError
from estbench.estimators.adapters.peer import Moments, OneRun, PeerFilter
from estbench.estimators.settings import scaled_rule
from estbench.shapes import Array, Float

EPOCH = datetime(2000, 1, 1)
"""Stone Soup needs dates; this one is arbitrary."""


@dataclass(frozen=True)
class StoneSoupEKF(PeerFilter):
    """Stone Soup's `ExtendedKalmanPredictor` and `-Updater`; they equal `ekf` up to rounding.

    Cost per step: n + 2 transitions and 2 n + 3 measurements, since it evaluates some twice, run by
    run in Python. Choose it to check either library.

    Attributes:
        model: the filter's model, of vectors only.
    """

    def load(self) -> None:
        """Import Stone Soup."""
        library()

    def predicted(self, x: Float[Array, " n"], P: Float[Array, "n n"], one: OneRun) -> Moments:
        """`predict` over one.dt."""
        prior = library().GaussianState(x[:, None], P, timestamp=EPOCH)
        predictor = self._predictor(library().Transition(one, x))
        out = predictor.predict(prior, timestamp=EPOCH + timedelta(seconds=one.dt))
        return _vector(out.state_vector), _matrix(out.covar)

    def updated(
        self, x: Float[Array, " n"], P: Float[Array, "n n"], y: Float[Array, " m"], one: OneRun
    ) -> tuple[Float[Array, " n"], Float[Array, "n n"], Moments]:
        """`update` by a hypothesis of the one measurement."""
        soup = library()
        prior = soup.GaussianStatePrediction(x[:, None], P, timestamp=EPOCH)
        detection = soup.Detection(
            y[:, None], timestamp=EPOCH, measurement_model=soup.Measurement(len(x), None, one)
        )
        hypothesis = soup.SingleHypothesis(prior, detection)
        out = self._updater().update(hypothesis)
        seen = hypothesis.measurement_prediction
        innovation = y - _vector(seen.state_vector), _matrix(seen.covar)
        return _vector(out.state_vector), _matrix(out.covar), innovation

    def _predictor(self, transition: Any) -> Any:
        return library().ExtendedKalmanPredictor(transition)

    def _updater(self) -> Any:
        return library().ExtendedKalmanUpdater(None, use_joseph_cov=True)


@dataclass(frozen=True)
class StoneSoupUKF(StoneSoupEKF):
    """Stone Soup's `UnscentedKalmanPredictor` and `-Updater`; they equal `ukf` up to rounding.

    Cost per step: that of the UKF, run by run in Python. Choose it to check either library.

    Attributes:
        model: the filter's model, of vectors only.
        alpha, beta, kappa: as in `UKF`.
    """

    alpha: float = 1.0
    beta: float = 2.0
    kappa: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        scaled_rule(self)

    def _predictor(self, transition: Any) -> Any:
        return library().UnscentedKalmanPredictor(
            transition, alpha=self.alpha, beta=self.beta, kappa=self.kappa
        )

    def _updater(self) -> Any:
        return library().UnscentedKalmanUpdater(
            None, alpha=self.alpha, beta=self.beta, kappa=self.kappa
        )


@cache
def library() -> Any:
    """The classes of Stone Soup in use, with f and h of the model as transition and measurement.

    Raises:
        MissingExtraError: Stone Soup is not installed.
    """
    names = {
        "base": ["Property"],
        "models.transition": ["TransitionModel"],
        "models.measurement": ["MeasurementModel"],
        "predictor.kalman": ["ExtendedKalmanPredictor", "UnscentedKalmanPredictor"],
        "updater.kalman": ["ExtendedKalmanUpdater", "UnscentedKalmanUpdater"],
        "types.state": ["GaussianState"],
        "types.prediction": ["GaussianStatePrediction"],
        "types.detection": ["Detection"],
        "types.hypothesis": ["SingleHypothesis"],
        "types.array": ["StateVector", "StateVectors"],
    }
    try:
        modules = {name: importlib.import_module(f"stonesoup.{name}") for name in names}
    except ImportError:
        raise MissingExtraError("stonesoup", "peers") from None
    soup = SimpleNamespace(
        **{name: getattr(modules[m], name) for m, found in names.items() for name in found}
    )

    def columns(values: Array) -> Any:
        """`(point, k)` as Stone Soup's columns."""
        kind = soup.StateVector if len(values) == 1 else soup.StateVectors
        return np.ascontiguousarray(values.T).view(kind)

    class Transition(soup.TransitionModel):
        one: OneRun = soup.Property(doc="the model")
        x: np.ndarray = soup.Property(doc="where Q is taken")
        ndim_state = property(lambda self: len(self.x))

        def function(self, state: Any, noise: Any = False, **kwargs: Any) -> Any:
            return columns(self.one.f(_points(state)))

        def jacobian(self, state: Any, **kwargs: Any) -> Array:
            return self.one.f_jacobian(_points(state)[0])[1]

        def covar(self, **kwargs: Any) -> Array:
            return self.one.process_noise(self.x)

        def rvs(self, num_samples: int = 1, **kwargs: Any) -> Any:
            raise NotImplementedError

        def pdf(self, state1: Any, state2: Any, **kwargs: Any) -> Any:
            raise NotImplementedError

    class Measurement(soup.MeasurementModel):
        one: OneRun = soup.Property(doc="the model")
        ndim_meas = property(lambda self: len(self.one.measurement_noise()))

        def function(self, state: Any, noise: Any = False, **kwargs: Any) -> Any:
            return columns(self.one.h(_points(state)))

        def jacobian(self, state: Any, **kwargs: Any) -> Array:
            return self.one.h_jacobian(_points(state)[0])[1]

        def covar(self, **kwargs: Any) -> Array:
            return self.one.measurement_noise()

        def rvs(self, num_samples: int = 1, **kwargs: Any) -> Any:
            raise NotImplementedError

        def pdf(self, state1: Any, state2: Any, **kwargs: Any) -> Any:
            raise NotImplementedError

    soup.Transition, soup.Measurement = Transition, Measurement
    return soup


def _points(state: Any) -> Array:
    """The state's vector or vectors `(point, n)`."""
    return np.asarray(state.state_vector, np.float64).T


def _vector(column: Any) -> Array:
    return np.asarray(column, np.float64)[:, 0]


def _matrix(covariance: Any) -> Array:
    return np.asarray(covariance, np.float64)
