"""An estimator beside robots that somebody else steps: rows that begin anew at any time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg.lapack import dposv

from estbench.errors import EstbenchError, EstimatorError, SelectionError, user_error_location
from estbench.estimators.beliefs import Fault, start, takes_keys
from estbench.estimators.protocol import Estimator
from estbench.inference.fusion import Delays, Fusion
from estbench.inference.inbox import Inbox
from estbench.inference.latest import LatestInnovations
from estbench.inference.sizes import Sizes
from estbench.sensors.clock import Event
from estbench.sensors.delivery import Delivery
from estbench.shapes import Array, Float, Int, Ints, Keys, Mask, UInt
from estbench.spaces.linalg import quiet, surely_finite
from estbench.spaces.manifold import Manifold
from estbench.spaces.selection import chosen
from estbench.spaces.semidefinite import RESOLUTION, range_form, surely_full_rank


@dataclass(eq=False)
class _Cohort:
    """Rows whose beliefs are computed together.

    Attributes:
        rows: their numbers; None is all.
        here: which of them are still in it `(len(rows),)`.
        fusion: their beliefs.
        log: their innovations.
    """

    rows: Ints | None
    here: Mask
    fusion: Fusion
    log: LatestInnovations


class LiveFilter:
    """The beliefs of many robots, and what became of them in the last step.

    All rows are one batch, unless what is computed depends on the time (`by_clock`) or the belief
    cannot be taken apart by rows: then rows that begin together are one. A row that breaks down is
    marked: call `step`, `settle` and `info` under `linalg.quiet`.

    Args:
        estimator: any object of the protocol.
        space: the state space.
        channels: channel -> the manifold of its readings, in the measurement's order.
        rows: how many robots.
        delays: what to do about late readings.
        threshold: a row has diverged while NEES, divided by its degrees of freedom, is above this.
        by_clock: whether estimator or model depend on the time.

    Attributes:
        random: whether the estimator draws random numbers, so that `start` needs keys.
        estimate: x̂ `(row, nx)`; a row that failed keeps its last finite one.
        cov: P `(row, n, n)`, likewise.
        failed: rows whose filter broke down, until they begin anew `(row,)`.
        innovation, nis, dof: of the readings that came in the last step; see `LatestInnovations`.
    """

    def __init__(
        self,
        estimator: Estimator,
        space: Manifold,
        channels: Mapping[str, Manifold],
        rows: int,
        delays: Delays | None = None,
        threshold: float = 1000.0,
        by_clock: bool = False,
    ):
        self.estimator, self.space, self.rows = estimator, space, rows
        self._channels, self._delays = dict(channels), delays or Delays()
        self._threshold, self._by_clock = threshold, by_clock
        self.random = takes_keys(estimator)
        self._label = type(getattr(estimator, "estimator", estimator)).__name__
        self._cohorts: list[_Cohort] = []
        self.estimate = np.zeros((rows, space.nx))
        self.cov = np.zeros((rows, space.n, space.n))
        self.failed = np.zeros(rows, bool)
        self._sizes = Sizes(space, rows)
        self._full = np.full(rows, space.n)  # degrees of freedom of NEES where P has full rank
        self._limit = np.full(rows, threshold * space.n)
        width = sum(channel.n for channel in channels.values())
        self.innovation = np.zeros((rows, width))
        self.nis, self.dof = np.zeros(rows), np.zeros(rows, np.int64)

    def start(
        self,
        rows: Int[Ints, " k"],
        mean: Float[Array, "row nx"],
        cov: Float[Array, "row n n"],
        keys: UInt[Keys, " row"] | None = None,
    ) -> None:
        """Begin anew in some rows; the others go on.

        Args:
            rows: their numbers.
            mean: x̂₀ of every row `(row, nx)`; only those of `rows` are used.
            cov: P₀ `(row, n, n)` likewise.
            keys: random keys `(row,)` for estimators that draw random numbers.
        """
        try:
            with quiet():
                self._begin(rows, mean, cov, keys)
        except EstbenchError:
            raise
        except (Exception, SystemExit) as error:  # a user's estimator may raise anything
            raise EstimatorError(f"{self._label} raised {user_error_location(error)}") from error
        self._sizes.forget(rows)
        self.estimate[rows], self.cov[rows], self.failed[rows] = mean[rows], cov[rows], False
        self.innovation[rows], self.nis[rows], self.dof[rows] = 0.0, 0.0, 0

    def begin(self) -> None:
        """A new step begins: forget the innovations of the last."""
        for cohort in self._cohorts:
            cohort.log.begin()

    def step(self, event: Event, u: Float[Array, "row nu"], arrived: Sequence[Delivery]) -> None:
        """Go on to the end of an event under controls u `(row, nu)`; fuse what arrives there."""
        try:
            for cohort in self._cohorts:
                self._advance(cohort, event, u, arrived)
        except EstbenchError:
            raise
        except (Exception, SystemExit) as error:  # a user's estimator may raise anything
            raise EstimatorError(f"{self._label} raised {user_error_location(error)}") from error

    def settle(self) -> None:
        """Take estimates, covariances and innovations from the beliefs at the end of a step."""
        if len(self._cohorts) == 1 and self._cohorts[0].rows is None:
            log, (mean, cov) = self._cohorts[0].log, self._moments(self._cohorts[0])
            self.innovation, self.nis, self.dof = log.innovation, log.nis, log.dof
            sound = self._cohorts[0].fusion.fault is None and not np.count_nonzero(self.failed)
            if sound and surely_finite(mean, cov):
                self.estimate, self.cov = np.array(mean), np.array(cov)
                return
        # Not in place: the last ones may still be in use.
        self.estimate, self.cov = self.estimate.copy(), self.cov.copy()
        self.innovation, self.nis, self.dof = (
            self.innovation.copy(), self.nis.copy(), self.dof.copy(),
        )  # fmt: skip
        for cohort in self._cohorts:
            self._take(cohort)

    def info(self, truth: Float[Array, "row nx"]) -> dict[str, Any]:
        """What a step's `info` says of every row, all of it copies, each with a leading row axis.

        Args:
            truth: x `(row, nx)`; the caller does not write to it any more.

        Returns:
            truth, estimate `(row, nx)`; error x ⊖ x̂ `(row, n)`; nees `(row,)`, on the range of P,
            inf where P is not semidefinite or the filter has failed; nees_dof `(row,)`, its degrees
            of freedom; innovation `(row, m)`; nis and nis_dof `(row,)`; diverged `(row,)`: the
            filter has failed, or NEES/nees_dof is above the threshold.
        """
        error = self.space.minus(truth, self.estimate)
        self._sizes.add(truth)
        self._sizes.add(self.estimate)
        nees, nees_dof = self._nees(error)
        full = nees_dof is self._full
        limit = self._limit if full else self._threshold * np.maximum(nees_dof, 1)
        diverged = nees > limit
        nis, innovation = self.nis.copy(), self.innovation.copy()
        if np.count_nonzero(self.failed) or not surely_finite(nees, nis, innovation):
            bad = ~np.isfinite(nees) | self.failed
            nees[bad] = np.inf
            diverged = self.failed | (diverged & ~bad)
            nis, innovation = np.nan_to_num(nis, nan=np.inf), np.nan_to_num(innovation)
        return {
            "truth": truth.copy(),
            "estimate": self.estimate.copy(),
            "error": error,
            "nees": nees,
            "nees_dof": nees_dof.copy(),
            "nis": nis,
            "nis_dof": self.dof.copy(),
            "innovation": innovation,
            "diverged": diverged,
        }

    def close(self) -> None:
        """Release the estimator and its model; no step can follow."""
        self._cohorts.clear()
        self.__dict__.pop("estimator", None)

    def _begin(self, rows: Ints, mean: Array, cov: Array, keys: Keys | None) -> None:
        if len(rows) == self.rows:
            self._cohorts = [self._cohort(None, mean, cov, keys)]
            return
        here = chosen(rows, self.rows)
        if self._cohorts and not self._by_clock:
            (cohort,) = self._cohorts
            fresh = start(self.estimator, mean, cov, keys)
            try:
                cohort.fusion.restart(here, fresh)
            except SelectionError:  # its beliefs cannot be taken apart
                self._by_clock = True
            else:
                cohort.log.forget(rows)
                return
        for cohort in self._cohorts:
            cohort.here &= ~(here if cohort.rows is None else here[cohort.rows])
        self._cohorts = [cohort for cohort in self._cohorts if cohort.here.any()]
        self._cohorts.append(
            self._cohort(rows, mean[rows], cov[rows], None if keys is None else keys[rows])
        )

    def _cohort(self, rows: Ints | None, mean: Array, cov: Array, keys: Keys | None) -> _Cohort:
        log = LatestInnovations(self._channels, len(mean), self._delays.window > 0)
        belief = start(self.estimator, mean, cov, keys)
        fusion = Fusion(self.estimator, belief, Inbox(self._channels), self._delays, log)
        return _Cohort(rows, np.ones(len(mean), bool), fusion, log)

    def _advance(
        self, cohort: _Cohort, event: Event, u: Array, arrived: Sequence[Delivery]
    ) -> None:
        here, rows = cohort.here, cohort.rows
        if rows is not None or np.count_nonzero(here) < len(here):
            rows = np.arange(self.rows) if rows is None else rows
            going = here if event.rows is None else here & event.rows[rows]
            if not going.any():
                return
            # Those that have left go along: nobody looks, and the belief need not be divided.
            together = not (here & ~going).any()
            u, event = u[rows], event._replace(rows=None if together else going)
            arrived = [part for d in arrived if (part := _of(d, rows, going)) is not None]
        oldest = cohort.fusion.step(event, u, arrived)
        cohort.log.settle(oldest)

    def _moments(self, cohort: _Cohort) -> tuple[Array, Array]:
        belief = cohort.fusion.belief
        return self.estimator.mean(belief), self.estimator.cov(belief)

    def _take(self, cohort: _Cohort) -> None:
        here, log, (mean, cov) = cohort.here, cohort.log, self._moments(cohort)
        rows = np.arange(self.rows) if cohort.rows is None else cohort.rows
        good = np.isfinite(mean).all(axis=-1) & np.isfinite(cov).all(axis=(-2, -1))
        good &= ~self.failed[rows] & here
        if cohort.fusion.fault is not None:
            good &= cohort.fusion.fault == Fault.NONE
        self.estimate[rows[good]], self.cov[rows[good]] = mean[good], cov[good]
        self.failed[rows[here]] = ~good[here]
        here_now = rows[here]
        self.innovation[here_now], self.nis[here_now] = log.innovation[here], log.nis[here]
        self.dof[here_now] = log.dof[here]

    def _nees(self, error: Array) -> tuple[Array, Ints]:
        """NEES and its degrees of freedom `(row,)`; NaN where P is not semidefinite."""
        if self.rows == 1:  # a fifth of the time
            factor, solved, fault = dposv(self.cov[0], error[0])
            if fault == 0 and surely_full_rank(factor, self.cov[0], self._sizes.bound):
                return np.array([error[0] @ solved]), self._full
        form = range_form(self.cov, error, RESOLUTION * self._sizes.largest)
        return form.value, form.dof


def _of(delivery: Delivery, rows: Ints, going: Mask) -> Delivery | None:
    """The part of a delivery that comes to some rows of a cohort."""
    mask = going if delivery.mask is None else delivery.mask[rows] & going
    if not mask.any():
        return None
    due = delivery.due if isinstance(delivery.due, int) else delivery.due[rows]
    return delivery._replace(due=due, y=delivery.y[rows], mask=None if mask.all() else mask)
