"""Smoothers as estimators: a filter whose beliefs are smoothed when the run is over."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from estbench.errors import EstimatorError
from estbench.estimators import registry
from estbench.estimators.beliefs import Gaussian
from estbench.estimators.factors import FactorBelief
from estbench.estimators.iplf import IPLF
from estbench.estimators.over import OverFilter
from estbench.estimators.protocol import Estimator, FilterHistory, windows
from estbench.estimators.settings import base, has_model, in_range, one_of, table, whole
from estbench.estimators.ukf import PREDICTION, SigmaPointFilter
from estbench.models.protocol import Model
from estbench.shapes import Array, Float
from estbench.smoothers.backward import gaussian
from estbench.smoothers.ipls import ipls
from estbench.smoothers.map import map_estimate
from estbench.smoothers.rts import rts
from estbench.smoothers.urts import urts


@dataclass(frozen=True)
class FilterThenSmooth(OverFilter):
    """Base of the smoothers: the filter `base`, and `smooth` of a subclass.

    Innovations, NIS and the estimate that a controller receives are those of the filter; errors,
    NEES and RMSE are those of the smoother.

    With a window the belief at each time is given the measurements up to the end of its window, and
    the event loop keeps no more than one window of beliefs in memory. Each window starts from the
    filter's posterior.

    Attributes:
        model: the filter's model.
        base: the filter, one of `bases`, or your own `package.module:Name`.
        settings: of the filter.
        window: length of a window, s; default the complete run.
    """

    model: Model
    base: str = "ekf"
    settings: Mapping[str, Any] = field(default_factory=dict)
    window: float | None = None
    bases: ClassVar[tuple[str, ...]] = ()
    _filter: Estimator = field(init=False, repr=False)

    def __post_init__(self) -> None:
        has_model(self)
        table(self, "settings")
        base(self, self.bases)
        if self.window is not None:
            in_range(self, "window", 0.0, low_open=True)
        object.__setattr__(self, "_filter", registry.create(self.base, self.settings, self.model))

    def check_schedule(self, duration: float, arrivals: int, given: Collection[str]) -> None:
        """Refuse a window that is longer than the run.

        Raises:
            EstimatorError: the window exceeds the duration.
        """
        if self.window is not None and self.window > duration + 1e-9:
            raise EstimatorError(
                f"window is {self.window:g} s but the run only {duration:g} s; shorten it, or "
                "leave it out for the whole run"
            )

    def smooth(self, history: FilterHistory) -> list[Gaussian]:
        """Window after window."""
        smoothed: list[Gaussian] = []
        for part in windows(history.times, self.window):
            found = self.smooth_window(history.part(part))
            smoothed += found if part.stop == len(history.times) else found[:-1]
        return smoothed

    def smooth_window(self, history: FilterHistory) -> list[Gaussian]:
        """The beliefs of one window."""
        raise NotImplementedError

    def mean(self, belief: Any) -> Float[Array, "run nx"]:
        """x̂ `(run, nx)`, filtered or smoothed."""
        return belief.mean if type(belief) is Gaussian else self._filter.mean(belief)

    def cov(self, belief: Any) -> Float[Array, "run n n"]:
        """P `(run, n, n)`, filtered or smoothed."""
        return belief.cov if type(belief) is Gaussian else self._filter.cov(belief)

    def _posteriors(self, beliefs: Sequence[Any]) -> list[Gaussian | FactorBelief]:
        """The filter's beliefs as plain Gaussians; those of a square-root filter as they are."""
        return [
            b
            if isinstance(b, FactorBelief)
            else Gaussian(mean := self.mean(b), self.cov(b), _fault(b, len(mean)))
            for b in beliefs
        ]


@dataclass(frozen=True)
class RTS(FilterThenSmooth):
    """Rauch-Tung-Striebel smoother after a linear or extended filter.

    See `estbench.smoothers.rts.rts`.

    Cost per step: the filter's, and n + 1 transitions and one Q with forward differences. Choose it
    to see what a run's data are worth when all of them may be used.
    """

    base: str = "sr_ekf"
    bases: ClassVar[tuple[str, ...]] = ("ekf", "iekf", "sr_ekf", "kf", "lkf", "cd_ekf")

    def smooth_window(self, history: FilterHistory) -> list[Gaussian]:
        """Backwards through the filter's posteriors."""
        posteriors = self._posteriors(history.beliefs)
        return rts(self.model, posteriors, history.controls, history.times)


@dataclass(frozen=True)
class URTS(FilterThenSmooth):
    """Unscented RTS smoother after a sigma-point filter, by its own points.

    See `estbench.smoothers.urts.urts`.

    Cost per step: that of the filter, one transition per sigma point (2 n + 1), and one Q. Choose
    it where you would choose the UKF.
    """

    base: str = "sr_ukf"
    bases: ClassVar[tuple[str, ...]] = ("ukf", "sr_ukf", "ckf", "ghkf", "rotated_ukf", "iplf")

    def smooth_window(self, history: FilterHistory) -> list[Gaussian]:
        """Backwards through the filter's posteriors, with the points of its predictions."""
        filter, posteriors = self._filter, self._posteriors(history.beliefs)
        passage = self.model, posteriors, history.controls, history.times
        if isinstance(filter, SigmaPointFilter | IPLF):
            beliefs = history.beliefs
            return urts(*passage, lambda k: filter.rule_at(beliefs[k], PREDICTION), filter.omega)
        rule = getattr(filter, "rule", None)
        return urts(*passage, rule and (lambda k: rule))


@dataclass(frozen=True)
class IPLS(FilterThenSmooth):
    """Iterated posterior linearization smoother after a sigma-point filter, by its own points.

    See `estbench.smoothers.ipls.ipls`.

    Cost per step: that of the filter, and up to `iterations` times its transitions and
    measurements. Choose it over `urts` where the filter's estimates are far from the smoothed ones.

    Attributes:
        iterations: maximal number of linearizations.
        tolerance: a run has converged when no coordinate changes by more standard deviations.
    """

    base: str = "iplf"
    bases: ClassVar[tuple[str, ...]] = ("iplf", "ukf", "ckf", "ghkf", "rotated_ukf")
    iterations: int = 10
    tolerance: float = 1e-3

    def __post_init__(self) -> None:
        one_of(self, "base", self.bases)
        super().__post_init__()
        whole(self, "iterations", 1, 1000)
        in_range(self, "tolerance", 0.0)

    def smooth_window(self, history: FilterHistory) -> list[Gaussian]:
        """Again and again over the window."""
        filter = self._filter
        assert isinstance(filter, SigmaPointFilter | IPLF)
        return ipls(
            self.model, [gaussian(b) for b in self._posteriors(history.beliefs)],
            history.controls, history.times, history.measurements,
            lambda k, purpose: filter.rule_at(history.beliefs[k], purpose),
            omega=filter.omega, iterations=self.iterations, tolerance=self.tolerance,
        )  # fmt: skip


@dataclass(frozen=True)
class MAP(FilterThenSmooth):
    """Maximum a posteriori smoother: the most probable trajectory of the run or of windows of it.

    Each window starts from the filter's posterior and is fitted to its own measurements, so that a
    window of one step is an iterated filter and one of the whole run the batch solution.

    Cost per step: the filter's, then as many Jacobians of f and h as iterations, and a sparse
    solution per run, which dominates. Choose it as the reference that no filter beats.

    Attributes:
        iterations: maximal number of linearizations.
        tolerance: a run has converged when no coordinate changes by more, in its own unit.
    """

    bases: ClassVar[tuple[str, ...]] = tuple(dict.fromkeys((*RTS.bases, *URTS.bases)))
    iterations: int = 20
    tolerance: float = 1e-7

    def __post_init__(self) -> None:
        super().__post_init__()
        whole(self, "iterations", 1, 1000)
        in_range(self, "tolerance", 0.0, low_open=True)

    def smooth_window(self, history: FilterHistory) -> list[Gaussian]:
        """The most probable trajectory, from the filter's."""
        filtered = self._posteriors(history.beliefs)
        return map_estimate(
            self.model, gaussian(filtered[0]), history.controls, history.times,
            [[], *history.measurements[1:]],  # the filter has fused the first ones already
            start=[belief.mean for belief in filtered],
            iterations=self.iterations, tolerance=self.tolerance,
        ).beliefs  # fmt: skip


def _fault(belief: Any, runs: int) -> NDArray[np.uint8]:
    """The belief's faults `(run,)`, if it keeps any."""
    fault = getattr(belief, "fault", None)
    return np.zeros(runs, np.uint8) if fault is None else fault
