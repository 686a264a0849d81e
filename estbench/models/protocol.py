"""The state-space model that every estimator sees: x⁺ = f(x, u) ⊞ w, y = h(x, u) ⊞ v."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from estbench.shapes import Array, Float
from estbench.spaces.manifold import Manifold

Channels = Sequence[str] | None
"""Names of the channels that deliver at one instant; None means all of them."""


@runtime_checkable
class Model(Protocol):
    """The methods that an estimator may call on a model. Times are in s.

    `x` may be `(run, nx)` or `(run, point, nx)`; `u` is `(run, nu)` and is constant over the
    interval. A row that cannot be computed (the simulation diverged) is NaN in the result. A
    component of a measurement that is +inf has no return (a ray that hits nothing): a filter does
    not use it; see `estimators.no_return`.
    """

    @property
    def space(self) -> Manifold:
        """The state's manifold."""
        ...

    @property
    def nu(self) -> int:
        """Number of controls."""
        ...

    def output(self, channels: Channels = None) -> Manifold:
        """The measurement's manifold for the channels that deliver."""
        ...

    def transition(
        self, x: Float[Array, "*lead nx"], u: Float[Array, "... nu"], t: float, dt: float
    ) -> Float[Array, "*lead nx"]:
        """f: the state at t + dt, without noise."""
        ...

    def transition_jacobian(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float, dt: float
    ) -> tuple[Float[Array, "run nx"], Float[Array, "run n n"]]:
        """f(x) and Φ = ∂f/∂x, from the tangent at x to that at f(x)."""
        ...

    def process_noise(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float, dt: float
    ) -> Float[Array, "... n n"]:
        """Q, the covariance of w in the tangent at f(x); one, or one per run."""
        ...

    def measurement(
        self,
        x: Float[Array, "*lead nx"],
        u: Float[Array, "... nu"],
        t: float,
        channels: Channels = None,
    ) -> Float[Array, "*lead ny"]:
        """h: the measurement without noise; +inf for a component without a return at x."""
        ...

    def measurement_jacobian(
        self,
        x: Float[Array, "run nx"],
        u: Float[Array, "run nu"],
        t: float,
        channels: Channels = None,
    ) -> tuple[Float[Array, "run ny"], Float[Array, "run m n"]]:
        """h(x) and H = ∂h/∂x, from the tangent at x to that at h(x).

        The row of a component without a return (+inf in h) is zero.
        """
        ...

    def measurement_noise(self, t: float, channels: Channels = None) -> Float[Array, "... m m"]:
        """R, the covariance of v in the tangent at h(x); one, or one per run."""
        ...
