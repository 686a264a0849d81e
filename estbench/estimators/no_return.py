"""Predicted readings without a return: +inf in the model's measurement (see `models.protocol`).

A filter does not use such a component: it is masked, as if it had not arrived. Of the points of a
filter some may have a return and others not. The points without one then get the reading of the
plane through those with one (least squares), as if the surface that is measured went on.
"""

import numpy as np

from estbench.shapes import Array, Bool, Float, Mask
from estbench.spaces.linalg import surely_finite
from estbench.spaces.manifold import Manifold

RANK = 1e-10
"""Smallest eigenvalue, relative to a variance, of a direction in which the points differ."""


def returned(
    residual: Float[Array, "run m"], mask: Bool[Mask, "run m"] | None
) -> Bool[Mask, "run m"] | None:
    """The mask without the components whose residual is -inf: no return is predicted.

    A measurement that is itself infinite is a fault, and not masked.

    Args:
        residual: y ⊖ ŷ.
        mask: True where a component arrived; None if all did.
    """
    if surely_finite(residual):
        return mask
    gone = np.isneginf(residual)
    if not gone.any():
        return mask
    return ~gone if mask is None else mask & ~gone


def extended(
    space: Manifold,
    output: Manifold,
    points: Float[Array, "run point nx"],
    images: Float[Array, "run point ny"],
    mask: Bool[Mask, "run m"] | None,
) -> tuple[Float[Array, "run point ny"], Bool[Mask, "run m"] | None]:
    """The readings at the points of a filter, all finite, and the mask of what may be fused.

    A component without a return at some points of a run is extended to these by the least-squares
    plane through the others, a + B (x ⊖ x₀). It is masked instead where fewer than half of the
    points have a return, or where these do not span what all points span.

    Args:
        space: the state space.
        output: the space of the readings.
        points: of each run.
        images: h at the points; +inf for a component without a return.
        mask: True where a component arrived; None if all did.
    """
    if surely_finite(images):
        return images, mask
    gone = np.isinf(images)
    run, component = np.nonzero(gone.any(axis=1))
    if not len(run):
        return images, mask
    out = images.copy()
    value = images[run, :, component]
    out[run, :, component] = _plane(space, points[run], value)
    lost = output.infinite(out).any(axis=1)
    out = np.where(np.isinf(out), 0.0, out)
    return out, np.asarray(~lost if mask is None else mask & ~lost)


def _plane(
    space: Manifold, points: Float[Array, "case point nx"], value: Float[Array, "case point"]
) -> Float[Array, "case point"]:
    """One component at the points of each case, extended where it is +inf, or +inf at all points.

    A point that is not finite (a dead particle) keeps its value and has no weight.
    """
    gone, known = np.isinf(value), np.isfinite(value)
    used = gone | known
    first = np.argmax(known, axis=1)[:, None, None]
    delta = space.minus(points, np.take_along_axis(points, first, axis=1))
    delta = np.where(used[..., None], delta, 0.0)
    _, scatter, _ = _moments(delta, used)
    scale = np.sqrt(np.diagonal(scatter, axis1=-2, axis2=-1))[:, None]
    delta = delta / np.where(scale > 0, scale, 1.0)
    _, scatter, total = _moments(delta, used)
    directions = (np.linalg.eigvalsh(scatter) > RANK).sum(axis=1)
    centre, scatter, count = _moments(delta, known)
    eigenvalues, vectors = np.linalg.eigh(scatter)
    spanned = eigenvalues > RANK
    inverse = np.where(spanned, 1.0 / np.where(spanned, eigenvalues, 1.0), 0.0)
    level = np.where(known, value, 0.0).sum(axis=1, keepdims=True) / count
    rise = np.where(known, value - level, 0.0)
    deviation = delta - centre[:, None]
    cross = (deviation.mT @ rise[..., None]) / count[..., None]
    slope = vectors @ (inverse[..., None] * (vectors.mT @ cross))
    plane = level + (deviation @ slope)[..., 0]
    enough = (2 * count >= total)[:, 0] & (spanned.sum(axis=1) == directions)
    return np.where(enough[:, None], np.where(gone, plane, value), np.where(used, np.inf, value))


def _moments(
    delta: Float[Array, "case point n"], chosen: Bool[Mask, "case point"]
) -> tuple[Float[Array, "case n"], Float[Array, "case n n"], Float[Array, "case 1"]]:
    """Mean and scatter of the chosen points, and how many they are, at least 1."""
    count = np.maximum(chosen.sum(axis=1, keepdims=True), 1).astype(np.float64)
    centre = (chosen[:, None, :].astype(np.float64) @ delta)[:, 0] / count
    deviation = np.where(chosen[..., None], delta - centre[:, None], 0.0)
    return centre, deviation.mT @ deviation / count[..., None], count
