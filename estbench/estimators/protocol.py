"""What an estimator is asked for, what it answers, and what a smoother looks back on."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from estbench.models.protocol import Channels
from estbench.shapes import Array, Bool, Float, Int, Ints, Mask


@dataclass(frozen=True, eq=False)
class Innovation:
    """What a measurement said: ν and S `(run, m)`, `(run, m, m)`.

    Attributes:
        residual: ν = y ⊖ ŷ; zero where nothing arrived.
        cov: S.
        white: L⁻¹ ν with S = L Lᵀ, standard normal for a consistent filter `(run, m)`.
        nis: νᵀ S⁻¹ ν `(run,)`.
        dof: how many components arrived `(run,)`.
    """

    residual: Float[Array, "run m"]
    cov: Float[Array, "... m m"]
    white: Float[Array, "run m"]
    nis: Float[Array, " run"]
    dof: Int[Ints, " run"]


@runtime_checkable
class Estimator(Protocol):
    """The methods an estimator of any family has; no base class is needed.

    It is built as `Class(model, **settings)`. Methods are pure: they return new beliefs.
    """

    def init(self, mean: Float[Array, "run nx"], cov: Float[Array, "run n n"]) -> Any:
        """The belief at the start from mean `(run, nx)` and covariance `(run, n, n)`."""
        ...

    def predict(self, belief: Any, u: Float[Array, "run nu"], t: float, dt: float) -> Any:
        """The belief at t + dt, given the belief at t and the control `(run, nu)` held between."""
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
        """The belief given the measurement y `(run, ny)` of `channels` at t.

        `mask` `(run, m)` is True where a component has arrived; None means everywhere.
        """
        ...

    def mean(self, belief: Any) -> Float[Array, "run nx"]:
        """x̂ `(run, nx)`."""
        ...

    def cov(self, belief: Any) -> Float[Array, "run n n"]:
        """P `(run, n, n)` in the tangent at x̂."""
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


@dataclass(frozen=True, eq=False)
class Measurement:
    """What arrived at one instant: y `(run, ny)` under u `(run, nu)`, as in `update`."""

    y: Float[Array, "run ny"]
    u: Float[Array, "run nu"]
    channels: Channels = None
    mask: Bool[Mask, "run m"] | None = None


@dataclass(frozen=True, eq=False)
class FilterHistory:
    """A filter's whole way through some runs, for a smoother to look back on.

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


@runtime_checkable
class Smoother(Estimator, Protocol):
    """An estimator that also looks back; its smoothed beliefs are the ones that are judged."""

    def smooth(self, passage: FilterHistory) -> Sequence[Any]:
        """K + 1 beliefs, each given all measurements (or those of a window)."""
        ...
