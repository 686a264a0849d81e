"""An estimator through measurements that are given: no robot, no sensors, no event loop."""

import numpy as np
from numpy.typing import ArrayLike

from estbench.errors import DimensionError
from estbench.estimators.beliefs import start
from estbench.estimators.protocol import Estimator, FilterHistory, Measurement
from estbench.models.protocol import Model
from estbench.shapes import Array, Float, Keys, UInt
from estbench.spaces.linalg import quiet


def follow(
    estimator: Estimator,
    mean: Float[Array, "run nx"],
    cov: Float[Array, "run n n"],
    y: ArrayLike,
    *,
    u: ArrayLike | None = None,
    times: ArrayLike | None = None,
    keys: UInt[Keys, " run"] | None = None,
) -> FilterHistory:
    """Predict to each time and update with what was measured then.

    From the belief N(mean, cov) at times[0], for k = 0, 1, ..., K - 1: the prediction from times[k]
    to times[k + 1] under u[k], then the update with y[k] (source 001, eq. 1-2).

    Args:
        estimator: any object of the protocol, over any model whose measurements are real numbers.
        mean: x̂₀.
        cov: P₀.
        y: measurements `(K, run, ny)` at times[1], ..., times[K]; NaN where none arrived.
        u: controls `(K, run, nu)`, each held to the next time; default 0.
        times: `(K + 1,)` in s, rising; default 0, 1, ..., K.
        keys: a random key per run for estimators whose `init` takes `keys`.

    Returns:
        The K + 1 beliefs, with all that a smoother needs: `estimator.smooth(history)`.

    Raises:
        DimensionError: y, u or times do not fit each other or the prior, or times do not rise.
    """
    y = np.asarray(y, dtype=np.float64)
    ny, nu = _widths(estimator, y, u)
    if y.ndim != 3 or y.shape[1:] != (len(mean), ny):
        raise DimensionError(f"y has shape {y.shape}; expected (step, {len(mean)}, {ny})")
    count, runs, _ = y.shape
    controls = np.zeros((count, runs, nu)) if u is None else np.asarray(u, dtype=np.float64)
    if controls.shape != (count, runs, nu):
        raise DimensionError(f"u has shape {controls.shape}; expected {(count, runs, nu)}")
    instants = np.asarray(range(count + 1) if times is None else times, dtype=np.float64)
    if instants.shape != (count + 1,) or not (np.diff(instants) > 0).all():
        raise DimensionError(
            f"times has shape {instants.shape}; expected {count + 1} rising numbers, one more than "
            "y has steps"
        )
    belief = start(estimator, mean, cov, keys)
    history = FilterHistory([belief], list(controls), instants.tolist(), [[]])
    with quiet():  # failed runs are marked
        for reading, held, t, end in zip(y, controls, history.times, history.times[1:]):
            belief = estimator.predict(belief, held, t, end - t)
            history.measurements.append([])
            came = ~np.isnan(reading)
            if came.any():
                mask = None if came.all() else came
                m = Measurement(np.where(came, reading, 0.0), held, None, mask)
                belief, _ = estimator.update(belief, m.y, m.u, end, m.channels, m.mask)
                history.measurements[-1].append(m)
            history.beliefs.append(belief)
    return history


def _widths(estimator: Estimator, y: Array, u: ArrayLike | None) -> tuple[int, int]:
    """Numbers in a measurement and in a control: of the model, if the estimator shows one."""
    model = getattr(estimator, "model", None)
    if isinstance(model, Model):
        return model.output().nx, model.nu
    return np.shape(y)[-1], 0 if u is None else np.shape(u)[-1]
