"""Starting well (source 002): a wrong or inflated prior, a fit of the first readings, at rest.

The batch fit is the most probable trajectory through the readings of the first `window` seconds
(`map_estimate`, nonlinear least squares by Gauss-Newton), under the prior and the process noise;
the static start assumes that the robot has not moved in it. No reading is used twice: until the
window has passed the estimate is the prior carried along by the model, then the estimator starts
from the fit's last state and covariance.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from estbench.errors import EstimatorError
from estbench.estimators.beliefs import Fault, Gaussian, start
from estbench.estimators.protocol import Estimator, Innovation, Measurement
from estbench.models.protocol import Channels, Model
from estbench.shapes import Array, Bool, Faults, Float, Keys, Mask, UInt
from estbench.smoothers.map import map_estimate
from estbench.spaces.manifold import Manifold
from estbench.spaces.patterns import expand

PerName = float | Sequence[float] | dict[str, float]


def displaced(
    space: Manifold,
    mean: Float[Array, " nx"],
    cov: Float[Array, "n n"],
    offset: PerName,
    inflate: PerName,
) -> tuple[Float[Array, " nx"], Float[Array, "n n"]]:
    """The filter's x̂₀ ⊞ offset and D P₀ D, D diagonal: a wrong start, an inflated covariance.

    Args:
        space: the state's manifold.
        mean: x̂₀.
        cov: P₀.
        offset: per coordinate, in its unit.
        inflate: factor on each coordinate's standard deviation.

    Raises:
        EstimatorError: a factor is not positive.
    """
    away = expand(offset, space.names, "start.offset")
    factor = expand(inflate, space.names, "start.inflate", default=1.0)
    if not (factor > 0).all():
        raise EstimatorError(
            f"start.inflate is {factor.min():g} for {space.names[int(factor.argmin())]}; use a "
            "factor above 0 on the standard deviation"
        )
    return space.plus(mean, away), cov * (factor[:, None] * factor)


def at_rest(
    mean: Float[Array, " nx"],
    cov: Float[Array, "n n"],
    values: slice,
    coordinates: slice,
    std: float,
) -> tuple[Float[Array, " nx"], Float[Array, "n n"]]:
    """The prior of a robot that does not move: velocities zero up to `std`, the rest as it was.

    Args:
        mean: x̂₀.
        cov: P₀.
        values: where the velocities stand in the state.
        coordinates: where they stand in the tangent.
        std: per velocity, in its unit.
    """
    mean, cov = mean.copy(), cov.copy()
    mean[values] = 0.0
    cov[coordinates], cov[:, coordinates] = 0.0, 0.0
    speeds = np.arange(len(cov))[coordinates]
    cov[speeds, speeds] = std**2
    return mean, cov


@dataclass(frozen=True, eq=False)
class Starting:
    """The belief of an estimator that waits for its start, or has started.

    Attributes:
        belief: the estimator's own; until it starts, the prior carried along.
        prior: at t = 0, None once started.
        keys: of the runs, for estimators that draw random numbers.
        times: of the window so far, s.
        controls: held between them.
        readings: what arrived at each time.
    """

    belief: Any
    prior: Gaussian | None
    keys: UInt[Keys, " run"] | None = None
    times: tuple[float, ...] = (0.0,)
    controls: tuple[Float[Array, "run nu"], ...] = ()
    readings: tuple[tuple[Measurement, ...], ...] = ((),)

    @property
    def fault(self) -> UInt[Faults, " run"]:
        """`Fault` of each run."""
        return self.belief.fault


@dataclass(frozen=True)
class WarmStart:
    """An estimator that starts from a fit of the first readings; afterwards it is as ever.

    Attributes:
        estimator: what is started.
        model: the filter's model.
        window: s of readings that are fitted.
        method: `batch`, or `static` for a robot that is at rest in the window (see `at_rest`).

    Raises:
        EstimatorError: the estimator is a smoother, which fits the whole run by itself.
    """

    estimator: Estimator
    model: Model
    window: float
    method: Literal["batch", "static"]

    def __post_init__(self) -> None:
        if hasattr(self.estimator, "smooth"):
            raise EstimatorError(
                f"{type(self.estimator).__name__}: start.method is {self.method!r}, but a smoother "
                "fits the whole run anyway; use start.method = 'prior' with start.inflate"
            )

    def init(
        self,
        mean: Float[Array, "run nx"],
        cov: Float[Array, "run n n"],
        keys: UInt[Keys, " run"] | None = None,
    ) -> Starting:
        """Wait with this mean and covariance."""
        prior = Gaussian(mean, cov, np.zeros(len(mean), np.uint8))
        return Starting(start(self.estimator, mean, cov, keys), prior, keys)

    def predict(self, belief: Starting, u: Float[Array, "run nu"], t: float, dt: float) -> Starting:
        """The estimator's prediction; it starts first when the window has passed."""
        if belief.prior is not None and t >= self.window - 1e-9:
            belief = Starting(self._fitted(belief, belief.prior), None)
        moved = replace(belief, belief=self.estimator.predict(belief.belief, u, t, dt))
        if belief.prior is None:
            return moved
        return replace(
            moved,
            times=(*belief.times, t + dt),
            controls=(*belief.controls, u),
            readings=(*belief.readings, ()),
        )

    def update(
        self,
        belief: Starting,
        y: Float[Array, "run ny"],
        u: Float[Array, "run nu"],
        t: float,
        channels: Channels = None,
        mask: Bool[Mask, "run m"] | None = None,
    ) -> tuple[Starting, Innovation]:
        """The estimator's update; until it has started the reading is put by."""
        if belief.prior is None:
            inner, innovation = self.estimator.update(belief.belief, y, u, t, channels, mask)
            return replace(belief, belief=inner), innovation
        *earlier, now = belief.readings
        readings = (*earlier, (*now, Measurement(y, u, channels, mask)))
        runs, m = len(y), self.model.output(channels).n
        nothing = Innovation(
            np.zeros((runs, m)), np.broadcast_to(np.eye(m), (runs, m, m)), np.zeros((runs, m)),
            np.zeros(runs), np.zeros(runs, np.int64),
        )  # fmt: skip
        return replace(belief, readings=readings), nothing

    def mean(self, belief: Starting) -> Float[Array, "run nx"]:
        """The estimate x̂."""
        return self.estimator.mean(belief.belief)

    def cov(self, belief: Starting) -> Float[Array, "run n n"]:
        """The covariance P."""
        return self.estimator.cov(belief.belief)

    def _fitted(self, belief: Starting, prior: Gaussian) -> Any:
        """The estimator's belief at the window's end; a run without a fit keeps what it has."""
        times, controls, readings = belief.times, belief.controls, belief.readings
        if self.method == "static":  # all readings are of one state
            times, controls = times[-1:], ()
            readings = (tuple(r for at_once in readings for r in at_once),)
        last = map_estimate(self.model, prior, controls, times, readings).beliefs[-1]
        lost = last.fault != Fault.NONE
        mean = np.where(lost[:, None], self.estimator.mean(belief.belief), last.mean)
        cov = np.where(lost[:, None, None], self.estimator.cov(belief.belief), last.cov)
        return start(self.estimator, mean, cov, belief.keys)
