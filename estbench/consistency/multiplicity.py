"""Many hypotheses with one false-alarm rate: Holm's correction, with weights."""

from collections.abc import Sequence

import numpy as np

from estbench.shapes import Array


def holm(p: Sequence[float] | Array, weights: Sequence[float] | Array | None = None) -> Array:
    """Holm's adjusted p-values `(k,)`.

    If those below α count as significant, the probability of any false alarm among all k is at
    most α, however the tests depend on each other. The smallest p/w is multiplied by the sum of all
    weights, the next by the sum of those that are left, and so on; the results are made monotone.
    With equal weights the i-th smallest p is multiplied by k - i + 1 (Holm 1979, Scand. J. Stat. 6,
    sec. 2 and 4).

    Args:
        p: p-values.
        weights: positive; a hypothesis of twice the weight is tested at twice the level. Default
            equal.
    """
    values = np.asarray(p, float)
    w = np.ones(len(values)) if weights is None else np.asarray(weights, float)
    order = np.argsort(values / w, kind="stable")
    left = w[order][::-1].cumsum()[::-1]
    steps = values[order] / w[order] * left
    adjusted = np.empty(len(values))
    adjusted[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return adjusted
