"""A channel that is not fused: its readings against what the estimate predicts of them."""

from dataclasses import dataclass

import numpy as np

from estbench.experiment.prepared import Setup
from estbench.inference.traces import Traces
from estbench.logs import clock
from estbench.logs.source import Log
from estbench.shapes import Array, Float
from estbench.spaces.linalg import cholesky, solve_lower


@dataclass(frozen=True, eq=False)
class Prediction:
    """The predictions of one channel.

    Attributes:
        channel: its name.
        times: of the readings, s.
        error: y ⊖ h(x̂), in the unit of the channel.
        std: √ of the diagonal of H P Hᵀ + R.
        ratio: eᵀ (H P Hᵀ + R)⁻¹ e divided by m.
    """

    channel: str
    times: Float[Array, " k"]
    error: Float[Array, "k m"]
    std: Float[Array, "k m"]
    ratio: Float[Array, " k"]


def predicted(prepared: Setup, label: str, log: Log, channel: str, traces: Traces) -> Prediction:
    """How well an estimator predicts the readings of a channel that it has not fused.

    Of each reading, e = y ⊖ h(x̂) at the time it was taken, from the belief that has fused what
    arrived of the other channels by then. Its covariance is H P Hᵀ + R.

    Args:
        prepared: the experiment.
        label: of the estimator.
        log: it was run on.
        channel: that was held out.
        traces: with the covariances.
    """
    part = next(p for p in log.channels if p.name == channel)
    whole = np.isfinite(part.y).all(axis=1)
    ticks = clock.ticks(part.taken[whole] - log.start)
    place = np.searchsorted([i.tick for i in log.instants], ticks)
    assert traces.cov is not None
    mean, cov = traces.mean[place + 1, 0], traces.cov[place + 1, 0]
    model = prepared.model(believed=prepared.believed[label])
    point, H = model.measurement_jacobian(mean, log.u[place], 0.0, (channel,))
    space = prepared.channel_spaces[channel]
    error = space.minus(part.y[whole], point)
    S = H @ cov @ H.mT + model.measurement_noise(0.0, (channel,))
    white = solve_lower(cholesky(S), error[..., None])[..., 0]
    return Prediction(
        channel, part.taken[whole] - log.start, error,
        np.sqrt(np.diagonal(S, axis1=-2, axis2=-1)), np.mean(white**2, axis=-1),
    )  # fmt: skip
