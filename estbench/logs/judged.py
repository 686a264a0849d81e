"""Errors and NEES of an estimator on a log that has the truth, whose own noise is counted."""

from dataclasses import replace

import numpy as np

from estbench.inference.traces import Traces
from estbench.logs.truth import Truth
from estbench.shapes import Bool, Ints, Mask
from estbench.spaces.directions import directions
from estbench.spaces.linalg import quiet
from estbench.spaces.manifold import Manifold
from estbench.spaces.semidefinite import RESOLUTION, range_form


def judged(traces: Traces, space: Manifold, truth: Truth) -> Traces:
    """The traces with the error, and NEES of the coordinates of which the truth is known.

    e = x ⊖ x̂ has the covariance P + T, where T is that of the truth; NEES is eᵀ (P + T)⁻¹ e of the
    known coordinates, with as many degrees of freedom.

    Args:
        traces: of one run without truth, with the covariances.
        space: of the state.
        truth: at its times, in the frame of the model.
    """
    assert traces.cov is not None
    mean, P = traces.mean[:, 0], traces.cov[:, 0] + np.diag(truth.noise**2)
    x = np.where(np.isfinite(truth.x), truth.x, mean)  # of what is not known: not used
    with quiet():
        error = space.minus(x, mean)
        size = np.fmax.accumulate(np.fmax(space.magnitude(x), space.magnitude(mean)), axis=0)
        nees, rank = np.full(len(mean), np.nan), traces.rank[:, 0].copy()
        along = np.full((len(mean), traces.along.shape[2]), np.nan)
        for rows, columns in _patterns(truth.known):
            form = range_form(
                P[np.ix_(rows, columns, columns)], error[np.ix_(rows, columns)],
                RESOLUTION * size[np.ix_(rows, columns)],
            )  # fmt: skip
            nees[rows], rank[rows] = form.value, form.dof
            if len(columns) == space.n:
                along[rows] = (form.white @ directions(space.n)) ** 2
        expected = np.sqrt(np.where(traces.std[:, 0] == 0, truth.noise**2,
                                    np.diagonal(P, axis1=-2, axis2=-1)))  # fmt: skip
    return replace(
        traces, truth=truth.x[:, None], error=np.where(truth.known, error, np.nan)[:, None],
        nees=nees[:, None], rank=rank[:, None], along=along[:, None],
        expected=expected[:, None] if truth.noise.any() else None,
    )  # fmt: skip


def _patterns(known: Bool[Mask, "time n"]) -> list[tuple[Ints, Ints]]:
    """The rows that know the same coordinates, and these; rows that know none are left out."""
    patterns, which = np.unique(known, axis=0, return_inverse=True)
    return [
        (np.flatnonzero(which.ravel() == i), np.flatnonzero(pattern))
        for i, pattern in enumerate(patterns)
        if pattern.any()
    ]
