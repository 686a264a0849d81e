"""One estimator on many robots, any of which may start anew: the filter bank of environments."""

import inspect
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv

from estbench.envs.merge import select
from estbench.envs.replay import Measurement, Memory
from estbench.errors import EstbenchError, EstimatorError, user_error_location
from estbench.estimators.protocol import Estimator, Innovation
from estbench.shapes import Array, Mask
from estbench.spaces.linalg import quadratic_form, surely_finite
from estbench.spaces.manifold import Manifold


class FilterBank:
    """The beliefs of `rows` robots, and what became of them in the last step.

    A row that breaks down is marked: call the methods under `linalg.quiet`.

    Args:
        estimator: any object of the estimators' protocol.
        space: the state space.
        slots: channel -> where its innovation stands, in the tangent of all channels.
        rows: how many robots.
        threshold: a row has diverged while NEES/n is above this.
        depth: how many steps back a late reading may belong.

    Attributes:
        belief: the estimator's belief of all rows.
        estimate: x̂ `(row, nx)`; a row that failed keeps its last finite one.
        cov: P `(row, n, n)`, likewise.
        failed: rows whose filter broke down, until they start anew `(row,)`.
        innovation: ν of each channel's last reading in this step `(row, m)`, 0 where none came.
        nis: νᵀ S⁻¹ ν, summed over the updates of this step `(row,)`.
        dof: how many components arrived in this step `(row,)`.
    """

    def __init__(
        self,
        estimator: Estimator,
        space: Manifold,
        slots: Mapping[str, slice],
        rows: int,
        threshold: float = 1000.0,
        depth: int = 0,
    ):
        self.estimator, self.space, self.rows = estimator, space, rows
        self._slots, self._every, self._threshold = dict(slots), tuple(slots), threshold
        self._takes_keys = "keys" in inspect.signature(estimator.init).parameters
        self._label = type(estimator).__name__
        self._width = max((s.stop for s in slots.values()), default=0)
        self._memory = Memory(depth)
        self.belief: Any = None
        self.estimate = np.zeros((rows, space.nx))
        self.cov = np.zeros((rows, space.n, space.n))
        self.failed = np.zeros(rows, bool)
        self.begin()

    def reset(
        self, mask: Mask, mean: Array, cov: Array, keys: NDArray[np.uint64] | None = None
    ) -> None:
        """Start the rows of a mask anew; the others go on.

        Args:
            mask: `(row,)`.
            mean: x̂₀ of every row `(row, nx)`; only those of the mask are used.
            cov: P₀ `(row, n, n)` likewise.
            keys: random keys `(row,)` for estimators that draw random numbers.
        """
        arguments = {"keys": keys} if self._takes_keys and keys is not None else {}
        fresh = self._guard("init", lambda: self.estimator.init(mean, cov, **arguments))
        partly = self.belief is not None and not mask.all()
        self.belief = self._select(mask, fresh, self.belief) if partly else fresh
        self._memory.reset(mask, fresh)
        self.estimate[mask], self.cov[mask], self.failed[mask] = mean[mask], cov[mask], False
        self.innovation[mask], self.nis[mask], self.dof[mask] = 0.0, 0.0, 0

    def predict(self, u: Array, t: float, dt: float, mask: Mask | None = None) -> None:
        """Every row, or those of a mask, from t to t + dt (s) under u `(row, nu)`."""
        self.belief = self.predicted(self.belief, u, t, dt, mask)
        self._memory.predicted(self.belief, u, t, dt, mask)

    def fuse(self, arrived: Sequence[Measurement], u: Array, t: float) -> None:
        """Condition on what has arrived at t (s), under u `(row, nu)`; late readings go back."""
        if self._memory.depth:
            if arrived:
                self.belief = self._memory.fuse(self, arrived)
            return
        for measurement in arrived:
            self.belief = self.updated(self.belief, measurement, u, t, True)

    def predicted(self, belief: Any, u: Array, t: float, dt: float, mask: Mask | None) -> Any:
        """The belief after an interval, in the rows of a mask; pure."""
        moved = self._guard("predict", lambda: self.estimator.predict(belief, u, t, dt))
        return moved if mask is None or mask.all() else self._select(mask, moved, belief)

    def updated(self, belief: Any, m: Measurement, u: Array, t: float, new: bool) -> Any:
        """The belief given a measurement; notes its innovation if it is new."""
        belief, seen = self._guard(
            "update", lambda: self.estimator.update(belief, m.y, u, t, m.channels, m.arrived)
        )
        if new:
            self._note(seen, m)
        return belief

    def begin(self) -> None:
        """Forget the innovations of the last step."""
        self.innovation = np.zeros((self.rows, self._width))
        self.nis, self.dof = np.zeros(self.rows), np.zeros(self.rows, np.int64)

    def settle(self) -> None:
        """Take mean and covariance from the belief after the updates of a step."""
        mean, cov = self.estimator.mean(self.belief), self.estimator.cov(self.belief)
        if not np.count_nonzero(self.failed) and surely_finite(mean, cov):
            self.estimate, self.cov = np.array(mean), np.array(cov)
            return
        good = np.isfinite(mean).all(axis=-1) & np.isfinite(cov).all(axis=(-2, -1)) & ~self.failed
        self.estimate = np.where(good[:, None], mean, self.estimate)
        self.cov = np.where(good[:, None, None], cov, self.cov)
        self.failed = ~good

    def info(self, truth: Array) -> dict[str, Any]:
        """What a step's `info` says of every row, all of it copies, each with a leading row axis.

        Args:
            truth: x `(row, nx)`.

        Returns:
            truth, estimate `(row, nx)`; error x ⊖ x̂ `(row, n)`; nees `(row,)`, inf where P is
            singular or the filter has failed; innovation `(row, m)`; nis and nis_dof `(row,)`;
            diverged `(row,)`: the filter has failed, or NEES/n is above the threshold.
        """
        error = self.space.minus(truth, self.estimate)
        nees = self._nees(error)
        diverged = nees > self._threshold * self.space.n
        if np.count_nonzero(self.failed) or not surely_finite(nees):
            bad = ~np.isfinite(nees) | self.failed
            nees[bad] = np.inf
            diverged = self.failed | (diverged & ~bad)
        return {
            "truth": truth.copy(),
            "estimate": self.estimate.copy(),
            "error": error,
            "nees": nees,
            "nis": _without_nan(self.nis, np.inf),
            "nis_dof": self.dof.copy(),
            "innovation": _without_nan(self.innovation),
            "diverged": diverged,
        }

    def _nees(self, error: Array) -> Array:
        """NEES `(row,)`; NaN where P has no Cholesky factor."""
        if self.rows > 1:
            return quadratic_form(self.cov, error)
        *_, solved, fault = dposv(self.cov[0], error[0])  # a fifth of the time, for one row
        return np.array([error[0] @ solved if fault == 0 else np.nan])

    def _note(self, seen: Innovation, m: Measurement) -> None:
        self.nis += seen.nis
        self.dof += seen.dof
        if m.arrived is None and m.channels == self._every:
            self.innovation = np.array(seen.residual)
            return
        start = 0
        for name in m.channels:
            slot = self._slots[name]
            part = slice(start, start + slot.stop - slot.start)
            ν = seen.residual[:, part]
            if m.arrived is not None:
                ν = np.where(m.arrived[:, part], ν, self.innovation[:, slot])
            self.innovation[:, slot] = ν
            start = part.stop

    def _select(self, mask: Mask, new: Any, old: Any) -> Any:
        return select(mask, new, old, f"estimator {self._label}: the belief")

    def _guard(self, verb: str, call: Any) -> Any:
        try:
            return call()
        except EstbenchError:
            raise
        except Exception as error:  # a user's estimator may raise anything
            raise EstimatorError(
                f"{self._label}.{verb} raised {user_error_location(error)}"
            ) from error


def _without_nan(values: Array, instead: float = 0.0) -> Array:
    """A copy, with a number for NaN."""
    return values.copy() if surely_finite(values) else np.nan_to_num(values, nan=instead)
