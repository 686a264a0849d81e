"""Candidates on measurements that are given, without a truth: only the likelihood is known."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from estbench.errors import EstbenchError
from estbench.estimators.beliefs import start
from estbench.estimators.likelihood import log_likelihood
from estbench.estimators.protocol import Estimator
from estbench.shapes import Array, Float
from estbench.spaces.linalg import quiet
from estbench.tuning.evaluation import Evaluation, Values, stacked

Make = Callable[[Values], Estimator]
"""From the values of a candidate to its estimator."""


class Given:
    """An `Evaluate` on recorded measurements.

    Args:
        make: builds the estimator of a candidate.
        mean: x̂₀ `(run, nx)`.
        cov: P₀ `(run, n, n)`.
        y: measurements `(K, run, ny)` at times[1], ..., times[K]; NaN where none arrived.
        u: controls `(K, run, nu)`, each held to the next time; default none.
        times: `(K + 1,)` in s; default 0, 1, ..., K.

    Attributes:
        names: none: no error is known.
        runs: how many runs.
    """

    names: tuple[str, ...] = ()

    def __init__(
        self,
        make: Make,
        mean: Float[Array, "run nx"],
        cov: Float[Array, "run n n"],
        y: ArrayLike,
        *,
        u: ArrayLike | None = None,
        times: ArrayLike | None = None,
    ):
        self._make, self._prior = make, (mean, cov)
        self._y = np.asarray(y, dtype=np.float64)
        count, self.runs = self._y.shape[:2]
        controls = np.zeros((count, self.runs, 0)) if u is None else u
        self._u = np.asarray(controls, dtype=np.float64)
        self._times = np.asarray(range(count + 1) if times is None else times, np.float64).tolist()

    def __call__(self, candidates: Sequence[Values]) -> Evaluation:
        """The log-likelihood of each candidate in each run."""
        return stacked([self._one(values) for values in candidates])

    def _one(self, values: Values) -> Evaluation:
        reason = ""
        try:
            with quiet():
                total = self._total(self._make(values))
        except EstbenchError as error:
            reason, total = str(error), np.full(self.runs, np.nan)
        return Evaluation(total[None], None, None, None, (reason,))

    def _total(self, estimator: Estimator) -> Float[Array, " run"]:
        """The sum over the updates of log p(y | earlier readings)."""
        belief, total = start(estimator, *self._prior), np.zeros(self.runs)
        for y, u, t, end in zip(self._y, self._u, self._times, self._times[1:]):
            belief = estimator.predict(belief, u, t, end - t)
            came = ~np.isnan(y)
            if not came.any():
                continue
            mask = None if came.all() else came
            belief, innovation = estimator.update(
                belief, np.where(came, y, 0.0), u, end, None, mask
            )
            total += log_likelihood(innovation, mask)
        return total
