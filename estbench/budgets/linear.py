"""The error budget by linear covariance analysis (Gelb 1974, ch. 7-8; Maybeck 1979, sec. 6.8).

The filter runs on the readings of a few true runs. Its own gains, and F and H at the true states,
propagate the error that each source causes by itself (`budgets.recursion`). Exact for a linear
model; else what the linearization, saturation, deadband and stuck-at faults do is left out.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from estbench.budgets.accounting import Accounting, Stamps
from estbench.budgets.recursion import Interval, Reading, Spread
from estbench.budgets.sources import NONLINEAR, Source, sources
from estbench.budgets.terms import Terms
from estbench.errors import EstimatorError
from estbench.estimators.kf import KF
from estbench.estimators.lkf import LKF
from estbench.estimators.protocol import Innovation
from estbench.experiment import recording
from estbench.experiment.prepared import Setup
from estbench.inference.fusion import Fusion
from estbench.inference.inbox import Inbox
from estbench.inference.initialization import WarmStart
from estbench.inference.run_subset import RunIndex
from estbench.models.protocol import Channels, Model
from estbench.sensors.clock import Event
from estbench.sensors.delivery import Delivery, divided
from estbench.shapes import Array, Bool, Float, Mask
from estbench.simulation.sources import Trajectory
from estbench.spaces.linalg import quiet

RUNS = 8
"""True runs along which the budget is computed: the gains differ little between runs."""


@dataclass(frozen=True, eq=False)
class Linear:
    """The budget of one estimator, by linear analysis.

    Attributes:
        sources: those that it knows.
        times: s.
        variance: mean square error that each source causes, mean over the runs, (unit)².
        together: what the wrong parameters, offsets and delays add because they are there at the
            same time; may be negative.
        believed: the filter's own variance.
        left_out: sources of which a linear analysis knows nothing.
        runs: how many there were.
    """

    sources: tuple[Source, ...]
    times: Float[Array, " time"]
    variance: Float[Array, "time source n"]
    together: Float[Array, "time n"]
    believed: Float[Array, "time n"]
    left_out: tuple[Source, ...]
    runs: int

    @property
    def total(self) -> Float[Array, "time n"]:
        """The mean square error of all sources."""
        return self.variance.sum(axis=1) + self.together


def linear(setup: Setup, label: str, runs: int = RUNS) -> Linear:
    """The budget of an estimator along the first runs of an experiment.

    Raises:
        EstimatorError: the estimator has no gain, or starts with a fit of the first readings.
        ScenarioError: no run has a truth and an estimate up to the end.
    """
    estimator = setup.estimator(label)
    model = _model(label, estimator)
    happened = _happened(setup, label, range(runs))
    terms = Terms(setup, label, model, happened)
    variance, together, believed = _along(setup, label, estimator, terms, happened)
    good = np.isfinite(variance).all(axis=(0, 2, 3)) & np.isfinite(happened.x).all(axis=(0, 2))
    if not good.any():
        raise EstimatorError(
            f"{label} or the truth fails in each of the {runs} runs; see `estbench run`, or raise "
            "--runs"
        )
    left = tuple(s for s in sources(setup, label) if s.kind in NONLINEAR)
    return Linear(
        terms.layout.sources, setup.times, variance[:, good].mean(axis=1),
        together[:, good].mean(axis=1), believed[:, good].mean(axis=1), left, int(good.sum()),
    )  # fmt: skip


def _model(label: str, estimator: Any) -> Model:
    """The model of the filter within an estimator.

    Raises:
        EstimatorError: it has none that the budget could use.
    """
    if isinstance(estimator, WarmStart):
        raise EstimatorError(
            f"{label}: the fit of the first readings (start.method) has no gain; use "
            '--monte-carlo, or start.method="prior"'
        )
    inner = estimator
    while hasattr(inner, "_filter"):
        inner = inner._filter
    if isinstance(inner, KF | LKF):
        raise EstimatorError(
            f"{label} linearizes at a fixed or nominal state, not at the truth; use --monte-carlo, "
            "or -e ekf"
        )
    model = getattr(inner, "model", None)
    if hasattr(estimator, "smooth") or not isinstance(model, Model):
        why = "looks back" if hasattr(estimator, "smooth") else "shows no `model`"
        raise EstimatorError(f"{label} {why}, so that it has no linear budget; use --monte-carlo")
    return model


def _happened(setup: Setup, label: str, runs: Sequence[int]) -> Trajectory:
    """The truth and readings that the estimator meets."""
    if setup.scenario.control.observe != "estimate":
        return recording.trajectory(setup, runs)
    found = recording.estimated(setup, label, runs, None)
    assert found is not None  # nobody stopped it
    return found[1]


def _along(
    setup: Setup, label: str, estimator: Any, terms: Terms, happened: Trajectory
) -> tuple[Array, Array, Array]:
    """Mean square errors by source, what is given together, and P, `(time, run, ...)`."""
    runs, n = terms.runs, setup.space.n
    delays, spaces, log = setup.delays(label), setup.channel_spaces, _NoLog(runs)
    steps = _Remembered(setup, terms, delays.window)
    stamps = Stamps(runs) if terms.layout.where("timing") else None
    start = Spread(*terms.layout.start(setup, label, terms.n, runs))
    accounting = Accounting(estimator, start, steps.interval, steps.reading, stamps)
    prior = [np.repeat(a[None], runs, axis=0) for a in setup.prior(label)]
    fusion = Fusion(accounting, accounting.init(*prior), Inbox(spaces), delays, log)
    ahead = None
    if stamps is not None:
        ahead = Fusion(stamps, stamps.init(*prior), Inbox(spaces), delays, log)
    index = {instant.tick: k for k, instant in enumerate(setup.instants, 1)}
    found = []

    def note() -> None:
        spread = fusion.belief.spread
        own = np.diagonal(accounting.cov(fusion.belief), axis1=-2, axis2=-1)
        found.append((*terms.layout.variances(spread.fixed, spread.moving, n), own))

    note()
    with quiet():
        for k, instant in enumerate(setup.instants):
            event, u = Event(instant.tick, instant), happened.u[k]
            # Both get the readings of one channel at a time, so that their updates correspond.
            arrived = happened.deliveries[k] if ahead is None else divided(happened.deliveries[k])
            if ahead is not None:
                ahead.step(event, u, [_stamped(d, index) for d in arrived])
            fusion.step(event, u, arrived)
            note()
    return tuple(np.stack(part) for part in zip(*found))  # type: ignore[return-value]


def _stamped(delivery: Delivery, index: dict[int, int]) -> Delivery:
    """A delivery whose readings are the index of the time at which they were taken."""
    return delivery._replace(y=np.full_like(delivery.y, index[delivery.taken]))


class _Remembered:
    """The terms of the last steps, which a late reading repeats."""

    def __init__(self, setup: Setup, terms: Terms, window: int):
        self._terms, self._window = terms, window
        self._spaces = setup.channel_spaces
        self._index = {_key(t): k for k, t in enumerate(setup.times)}
        self._kept: dict[tuple[int, Any], Any] = {}

    def interval(self, t: float) -> Interval:
        k = self._index[_key(t)]
        return self._known(k, None, lambda: self._terms.interval(k))

    def reading(self, t: float, channels: Channels, taken: Array | None) -> Reading:
        k, names = self._index[_key(t)], tuple(channels or self._spaces)
        if taken is None:
            none = [None] * len(names)
            return self._known(k, names, lambda: self._terms.reading(k, names, none))
        first = np.cumsum([0, *(self._spaces[name].nx for name in names)])
        return self._terms.reading(k, names, [taken[:, i] for i in first[:-1]])

    def _known(self, k: int, what: Any, make: Callable[[], Any]) -> Any:
        if not self._window:
            return make()
        if (k, what) not in self._kept:
            if what is None:  # no reading goes further back
                self._kept = {at: v for at, v in self._kept.items() if at[0] >= k - self._window}
            self._kept[k, what] = make()
        return self._kept[k, what]


def _key(t: float) -> float:
    return round(t, 9)


@dataclass
class _NoLog:
    """An `InnovationLog` that keeps nothing."""

    rows: int

    def clear(self, k: int, rows: RunIndex) -> None:
        """Nothing."""

    def put(
        self,
        k: int,
        layer: int,
        channels: Sequence[str],
        innovation: Innovation,
        mask: Bool[Mask, "run m"] | None,
        rows: RunIndex,
    ) -> None:
        """Nothing."""
