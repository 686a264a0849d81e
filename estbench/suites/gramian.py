"""The information on the state at the start that has been gathered by each time.

    I(t) = Σ Sᵀ Φⱼᵀ Hⱼᵀ Rⱼ⁻¹ Hⱼ Φⱼ S   over the readings j that were taken by t,

with S Sᵀ = P₀ and Φⱼ the transition from the start: the observability Gramian in units of the
prior's standard deviations (Kailath 1980, sec. 9.2; along a motion: Krener & Ide 2009). Without
process noise the covariance at the start is then S (1 + I)⁻¹ Sᵀ: an eigenvalue of 1 halves the
variance along its direction, one of 0 is a direction of which no reading says anything.
"""

from collections.abc import Iterator

import numpy as np

from estbench.shapes import Array, Float
from estbench.spaces.linalg import symmetrize
from estbench.suites.along import Motion


def gathered(motion: Motion) -> Iterator[Float[Array, "run r r"]]:
    """I at each time, from the start on; NaN from where a Jacobian is not finite.

    Args:
        motion: of some runs.
    """
    runs, r = motion.x.shape[1], motion.root.shape[1]
    total = np.zeros((runs, r, r))
    way = np.broadcast_to(motion.root, (runs, *motion.root.shape))
    yield total
    for step in motion.steps():
        way = step.F @ way
        for _, W, mask in step.seen:
            seen = W @ way
            part = seen.mT @ seen
            total = total + (part if mask is None else np.where(mask[:, None, None], part, 0.0))
        yield symmetrize(total)


def left(
    information: Float[Array, "*any r r"], root: Float[Array, "n r"]
) -> Float[Array, "*any n"]:
    """Standard deviations at the start given the information, over those before it.

    NaN for a coordinate that is known exactly at the start.
    """
    prior = (root**2).sum(axis=1)
    values, vectors = np.linalg.eigh(information)
    V = root @ vectors
    posterior = (V**2 / (1.0 + np.maximum(values, 0.0))[..., None, :]).sum(axis=-1)
    return np.sqrt(np.where(prior > 0, posterior / np.where(prior > 0, prior, 1.0), np.nan))
