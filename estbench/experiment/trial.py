"""A user's own estimator is tried on a robot before its runs."""

import numpy as np

from estbench.errors import EstbenchError, EstimatorError, user_error_location
from estbench.estimators.protocol import Estimator
from estbench.inference.answers import Answers
from estbench.inference.probe import probe_estimator
from estbench.models.probe import spread
from estbench.robots.model import MujocoModel
from estbench.sensors.timing import Instant
from estbench.shapes import Array, Float
from estbench.spaces.linalg import quiet

_RUNS = 3


def try_estimator(
    label: str,
    estimator: Estimator,
    model: MujocoModel,
    prior: tuple[Float[Array, " nx"], Float[Array, "n n"]],
    u: Float[Array, " nu"],
    instant: Instant,
) -> None:
    """Try it on a few runs about the prior, with readings without noise.

    Args:
        label: the estimator's label.
        estimator: one of estbench's own needs no trial.
        model: the filter's model.
        prior: x̂₀ and P₀.
        u: the nominal control.
        instant: the first one.

    Raises:
        EstimatorError, DimensionError: it is refused (see `probe_estimator`), or raises.
    """
    if Answers(estimator).own:
        return
    mean, cov, control = (np.repeat(a[None], _RUNS, axis=0) for a in (*prior, u))
    channels = tuple(c.name for c in model.channels)
    width = model.output(channels).n
    try:
        with quiet():
            mean = spread(model.space, mean, cov)
            y = model.measurement(mean, control, instant.end, channels)
            probe_estimator(
                getattr(estimator, "estimator", estimator), (mean, cov), control, y,
                (instant.start, instant.end), width, channels, np.arange(_RUNS, dtype=np.uint64),
            )  # fmt: skip
    except (EstbenchError, MemoryError):
        raise
    except (Exception, SystemExit) as error:  # a user's estimator may raise anything
        raise EstimatorError(f"{label} raised {user_error_location(error)}") from error
