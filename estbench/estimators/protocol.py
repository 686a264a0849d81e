"""The protocols of estimators and smoothers, and the values that they take and return."""

from bisect import bisect_right
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from estbench.models.protocol import Channels
from estbench.shapes import Array, Bool, Float, Int, Ints, Mask
from estbench.spaces.linalg import solve_lower_transposed


@dataclass(frozen=True, eq=False)
class Gain:
    """The gain K of an update, x̂⁺ = x̂⁻ ⊞ K ν, as the update has it: it costs nothing to keep.

    Attributes:
        scaled: K L.
        factor: L, lower triangular, with S = L Lᵀ.
    """

    scaled: Float[Array, "run n m"]
    factor: Float[Array, "run m m"]

    @property
    def matrix(self) -> Float[Array, "run n m"]:
        """K, with a zero column where a component did not arrive."""
        return solve_lower_transposed(self.factor, self.scaled.mT).mT


@dataclass(frozen=True, eq=False)
class Innovation:
    """The innovation of one measurement.

    Attributes:
        residual: ν = y ⊖ ŷ; zero where a component did not arrive.
        cov: S, the covariance of ν.
        white: L⁻¹ ν with S = L Lᵀ; standard normal for a consistent filter.
        nis: νᵀ S⁻¹ ν.
        dof: number of components that arrived.
        factor: L, with the rows of the identity where a component did not arrive; None if the
            estimator does not show it.
        log_likelihood: log p(y | earlier readings) where that is not log N(ν; 0, S); else None.
        gated: number of components that arrived and that the estimator did not use; else None.
        gain: the gain K, or the factors of it; None if the update is not linear in ν, or the
            estimator does not show it. `estbench budget` needs it.
    """

    residual: Float[Array, "run m"]
    cov: Float[Array, "... m m"]
    white: Float[Array, "run m"]
    nis: Float[Array, " run"]
    dof: Int[Ints, " run"]
    factor: Float[Array, "run m m"] | None = None
    log_likelihood: Float[Array, " run"] | None = None
    gated: Int[Ints, " run"] | None = None
    gain: Gain | Float[Array, "run n m"] | None = None


@runtime_checkable
class Estimator(Protocol):
    """The methods of an estimator; no base class is needed.

    It is built as `Class(model, **settings)`. Methods are pure: they return new beliefs.
    """

    def init(self, mean: Float[Array, "run nx"], cov: Float[Array, "run n n"]) -> Any:
        """The belief at the start, N(mean, cov)."""
        ...

    def predict(self, belief: Any, u: Float[Array, "run nu"], t: float, dt: float) -> Any:
        """The belief at t + dt from that at t, under the control u, constant in between."""
        ...

    def update(
        self,
        belief: Any,
        y: Float[Array, "run ny"],
        u: Float[Array, "run nu"],
        t: float,
        channels: Channels = None,
        mask: Bool[Mask, "run m"] | None = None,
    ) -> tuple[Any, Innovation]:
        """The belief given the measurement y of `channels` at t.

        Args:
            belief: the prior.
            y: the measurement.
            u: the control at t.
            t: time, s.
            channels: names of the channels that y consists of; None for all.
            mask: True where a component of y has arrived; None if all have.
        """
        ...

    def mean(self, belief: Any) -> Float[Array, "run nx"]:
        """The estimate x̂."""
        ...

    def cov(self, belief: Any) -> Float[Array, "run n n"]:
        """The covariance P in the tangent at x̂."""
        ...


@runtime_checkable
class ScheduleCheck(Protocol):
    """An optional method of an estimator: it refuses runs that are too short for its settings."""

    def check_schedule(self, duration: float, arrivals: int, given: Collection[str]) -> None:
        """Compare the settings with the length of a run; called before anything is simulated.

        Args:
            duration: of each run, s.
            arrivals: instants of each run at which readings are due.
            given: names of the settings that the scenario gives; the others have their defaults.

        Raises:
            EstimatorError: the run is too short. The estimator's label is put before the message.
        """
        ...


@runtime_checkable
class TimeDependent(Protocol):
    """An optional attribute of an estimator, for rows whose clocks differ."""

    @property
    def depends_on_time(self) -> bool:
        """Whether the estimator itself, apart from its model, uses `t` of predict or update."""
        ...


def depends_on_time(estimator: Any) -> bool:
    """Whether an estimator says that it depends on the time; one that says nothing does not."""
    return isinstance(estimator, TimeDependent) and estimator.depends_on_time


@dataclass(frozen=True, eq=False)
class Measurement:
    """One measurement, with the arguments of `Estimator.update`."""

    y: Float[Array, "run ny"]
    u: Float[Array, "run nu"]
    channels: Channels = None
    mask: Bool[Mask, "run m"] | None = None


@dataclass(frozen=True, eq=False)
class FilterHistory:
    """The beliefs, controls and measurements of a filter over complete runs, for a smoother.

    Attributes:
        beliefs: K + 1, the first at the start, the others after the updates.
        controls: K, each `(run, nu)`, held from one time to the next.
        times: K + 1, in s.
        measurements: K + 1 lists of what was fused at each time; the first is empty.
    """

    beliefs: list[Any]
    controls: list[Array]
    times: list[float]
    measurements: list[list[Measurement]]

    def part(self, where: slice) -> "FilterHistory":
        """The history of a window.

        Args:
            where: from its first time to the one after its last.
        """
        held = slice(where.start, where.stop - 1)
        return FilterHistory(
            self.beliefs[where], self.controls[held], self.times[where], self.measurements[where]
        )

    def forget(self, where: slice) -> None:
        """Drop what is known of some times."""
        for values in (self.beliefs, self.controls, self.measurements):
            values[where] = [None] * len(values[where])  # type: ignore[list-item]


def windows(times: Sequence[float], length: float | None) -> Iterator[slice]:
    """Windows that share their ends, each at least one step long.

    Args:
        times: K + 1, in s.
        length: of a window, s; None for one of all times.

    Yields:
        From the first time of a window to the one after its last.
    """
    first, last = 0, len(times) - 1
    while first < last:
        end = last
        if length is not None:
            end = max(bisect_right(times, times[first] + length + 1e-9) - 1, first + 1)
        yield slice(first, end + 1)
        first = end


@runtime_checkable
class Smoother(Estimator, Protocol):
    """An estimator that also looks back; its smoothed beliefs are the ones that are judged.

    One with an attribute `window`, in s and not None, is asked for each of these `windows` as soon
    as it is complete, so that no more than one is kept; any other for the whole run at its end.
    """

    def smooth(self, history: FilterHistory) -> Sequence[Any]:
        """K + 1 beliefs, each given all measurements (or those of a window)."""
        ...
