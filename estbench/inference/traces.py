"""What one estimator did on some runs, and the recorder that compares it with the truth."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from estbench.estimators.beliefs import Fault
from estbench.estimators.protocol import Estimator
from estbench.inference.answers import Answers
from estbench.inference.lags import correlation
from estbench.shapes import Array, Bool, Faults, Float, Int, Ints, Mask, UInt
from estbench.spaces.directions import directions
from estbench.spaces.manifold import Manifold
from estbench.spaces.semidefinite import RESOLUTION, range_form


@dataclass(frozen=True, eq=False)
class Traces:
    """One estimator over some runs, time-major; index 0 is the prior at t = 0.

    Attributes:
        truth: x; NaN, as all that is compared with it, where it is not known.
        mean: x̂.
        error: x ⊖ x̂.
        std: sqrt of P's diagonal; 0 where the coordinate is known exactly.
        nees: NEES on the range of P, not divided by its degrees of freedom.
        rank: degrees of freedom of NEES: n, less what P says is known exactly.
        along: squares of the whitened error along each of `spaces.directions`; NaN where P is
            singular.
        nis: NIS, not divided by m; NaN where nothing arrived.
        dof: how many components arrived.
        log_likelihood: log p(y | earlier readings), 0 where nothing arrived.
        gated: how many of the components that arrived the estimator did not use.
        channel_nis: NIS/m of each channel given those before it, NaN where nothing arrived.
        lags: sums of ν̃ₖ·ν̃ₖ₋ₗ, l = 0, 1, ..., of whitened innovations ν̃.
        lag_terms: how many products of two numbers are in each.
        fault: `Fault` of each run.
        fault_step: index of the instant at which it failed, -1 for none.
        late: per run, readings that came after the window and were not fused.
        cpu_time: seconds of one core spent in predict and update, all runs together.
        cov: P when asked for, else None.
        innovation: ν when asked for, NaN where nothing was fused.
        innovation_cov: S of the components fused together, likewise.
        bound: numbers whose mean over the runs is the bound on the mean square error, (unit)²;
            None where it was not computed.
        expected: σ of the error where the truth has noise of its own; None where it has none.
    """

    truth: Float[Array, "time run nx"]
    mean: Float[Array, "time run nx"]
    error: Float[Array, "time run n"]
    std: Float[Array, "time run n"]
    nees: Float[Array, "time run"]
    rank: Int[Ints, "time run"]
    along: Float[Array, "time run direction"]
    nis: Float[Array, "time-1 run"]
    dof: Int[Ints, "time-1 run"]
    log_likelihood: Float[Array, "time-1 run"]
    gated: Int[Ints, "time-1 run"]
    channel_nis: Float[Array, "time-1 run channel"]
    lags: Float[Array, "run lag"]
    lag_terms: Int[Ints, "run lag"]
    fault: UInt[Faults, " run"]
    fault_step: Int[Ints, " run"]
    late: Int[Ints, " run"]
    cpu_time: float
    cov: Float[Array, "time run n n"] | None = None
    innovation: Float[Array, "time run m"] | None = None
    innovation_cov: Float[Array, "time run m m"] | None = None
    bound: Float[Array, "time run n"] | None = None
    expected: Float[Array, "time run n"] | None = None

    @property
    def sigma(self) -> Float[Array, "time run n"]:
        """σ that the error should have: that of the filter, with the noise of the truth."""
        return self.std if self.expected is None else self.expected

    @property
    def lag_one(self) -> Float[Array, " run"]:
        """Lag-one correlation of the whitened innovations, NaN without two of them."""
        return correlation(self.lags, self.lag_terms)[:, 1]


class Recorder:
    """The traces of one estimator as they grow.

    Args:
        estimator: any object of the protocol.
        space: the state space.
        count: instants that are held at once; those before are to be let go (`drop`).
        runs: how many.
        keep_cov: whether to record full covariances.
    """

    def __init__(
        self, estimator: Estimator, space: Manifold, count: int, runs: int, keep_cov: bool
    ):
        n = space.n
        self._first = 0  # the time of the first row
        self._space, self._shape = space, (runs, space.nx, n)
        self.truth, self.mean = (np.empty((count + 1, runs, space.nx)) for _ in range(2))
        self._error, self._std = (np.empty((count + 1, runs, n)) for _ in range(2))
        self._nees, self._rank = np.empty((count + 1, runs)), np.empty((count + 1, runs), np.int64)
        self._directions = directions(n)
        self._along = np.empty((count + 1, runs, self._directions.shape[1]))
        self._size = np.zeros((runs, n))
        self._cov = np.empty((count + 1, runs, n, n)) if keep_cov else None
        self._fault, self._fault_step = np.zeros(runs, np.uint8), np.full(runs, -1)
        self._answers = Answers(estimator)
        self.judged = True  # whether the truth is known

    def add(
        self,
        index: int,
        x: Float[Array, "run nx"] | None,
        belief: Any,
        fault: UInt[Faults, " run"] | None = None,
    ) -> None:
        """Compare the belief with the true state at the index-th time.

        Args:
            index: of the time.
            x: the true states; None where they are not known, at all times then.
            belief: of all runs.
            fault: of each run, where the estimator's innovations have shown one.
        """
        m, P = self._answers.moments(belief, *self._shape)
        self.judged = x is not None
        x = m if x is None else x
        row = index - self._first
        self.truth[row], self.mean[row] = x, m
        error = self._space.minus(x, m)
        self._error[row] = error
        # A coordinate that was large has the rounding errors of that time, though it is small now.
        self._size = np.fmax(
            self._size, np.fmax(self._space.magnitude(x), self._space.magnitude(m))
        )
        form = range_form(P, error, RESOLUTION * self._size)
        variance = np.where(form.known, 0.0, np.diagonal(P, axis1=-2, axis2=-1))
        self._std[row] = np.sqrt(np.where(variance >= 0, variance, np.nan))
        self._nees[row], self._rank[row] = form.value, form.dof
        self._along[row] = (form.white @ self._directions) ** 2
        if self._cov is not None:
            self._cov[row] = P
        for found in (self._answers.asymmetry(P), fault):
            if found is not None:
                self._note(index, found > 0, found)
        broken = ~np.isfinite(self._nees[row])
        if broken.any():
            self._mark(index, broken, x, m, P, self._answers.reasons(belief, self._shape[0]))

    def _mark(
        self,
        index: int,
        broken: Bool[Mask, " run"],
        x: Float[Array, "run nx"],
        m: Float[Array, "run nx"],
        P: Float[Array, "run n n"],
        reason: UInt[Faults, " run"] | None,
    ) -> None:
        """Note when and why each broken run failed first."""
        finite = np.isfinite(P).all(axis=(-2, -1)) & np.isfinite(m).all(axis=-1)
        code = np.where(finite, Fault.COVARIANCE, Fault.STATE)
        if reason is not None:
            code = np.where(reason > 0, reason, code)
        self._note(index, broken, np.where(np.isfinite(x).all(axis=-1), code, Fault.TRUTH))

    def _note(self, index: int, broken: Bool[Mask, " run"], code: Array | Faults) -> None:
        new = broken & (self._fault == Fault.NONE)
        self._fault[new], self._fault_step[new] = code[new], index

    def estimate(self, index: int) -> Float[Array, "run nx"]:
        """The mean at the index-th time."""
        return self.mean[index - self._first]

    def traces(self, fused: Mapping[str, Any], stop: int | None = None) -> Traces:
        """What was recorded, with what the event loop counted.

        Args:
            fused: of the innovations, of the same instants.
            stop: the first time that is left out; None for none.
        """
        if not self.judged:  # nothing is known of the errors
            for unknown in (self.truth, self._error, self._nees, self._along):
                unknown[:] = np.nan
        rows = slice(None if stop is None else stop - self._first)
        return Traces(
            truth=self.truth[rows], mean=self.mean[rows], error=self._error[rows],
            std=self._std[rows], nees=self._nees[rows], rank=self._rank[rows],
            along=self._along[rows], fault=self._fault, fault_step=self._fault_step,
            cov=None if self._cov is None else self._cov[rows], **fused,
        )  # fmt: skip

    def drop(self, first: int) -> None:
        """Let the times before one go; the traces that were given are void."""
        gone, self._first = first - self._first, first
        for kept in (
            self.truth, self.mean, self._error, self._std, self._nees, self._rank, self._along,
            self._cov,
        ):  # fmt: skip
            if kept is not None:
                kept[: len(kept) - gone] = kept[gone:].copy()
