"""The state-space model that every estimator sees: x⁺ = f(x, u) ⊞ w, y = h(x, u) ⊞ v."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from estbench.shapes import Array
from estbench.spaces.manifold import Manifold

Channels = Sequence[str] | None
"""Names of the channels that deliver at one instant; None means all of them."""


@runtime_checkable
class Model(Protocol):
    """What an estimator may ask of a model. Times in s; every array has a leading run axis.

    `x` may be `(run, nx)` or `(run, point, nx)`; `u` is `(run, nu)` and is held over the interval.
    A row that cannot be computed (a simulation that blew up) comes back as NaN.
    """

    @property
    def space(self) -> Manifold:
        """The state's manifold."""
        ...

    @property
    def nu(self) -> int:
        """Count of controls."""
        ...

    def output(self, channels: Channels = None) -> Manifold:
        """The measurement's manifold for the channels that deliver."""
        ...

    def transition(self, x: Array, u: Array, t: float, dt: float) -> Array:
        """f: the state after `dt` from time `t`, without noise; shape of `x`."""
        ...

    def transition_jacobian(self, x: Array, u: Array, t: float, dt: float) -> tuple[Array, Array]:
        """f(x) `(run, nx)` and Φ = ∂f/∂x `(run, n, n)` between the tangents at x and at f(x)."""
        ...

    def process_noise(self, x: Array, u: Array, t: float, dt: float) -> Array:
        """Q, the covariance of w `(n, n)` or `(run, n, n)` in the tangent at f(x)."""
        ...

    def measurement(self, x: Array, u: Array, t: float, channels: Channels = None) -> Array:
        """h: the measurement `(..., ny)` without noise."""
        ...

    def measurement_jacobian(
        self, x: Array, u: Array, t: float, channels: Channels = None
    ) -> tuple[Array, Array]:
        """h(x) `(run, ny)` and H = ∂h/∂x `(run, m, n)` from the tangent at x to that at h(x)."""
        ...

    def measurement_noise(self, t: float, channels: Channels = None) -> Array:
        """R, the covariance of v `(m, m)` or `(run, m, m)` in the tangent at h(x)."""
        ...
