"""A model whose noise is scaled."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from estbench.errors import ScenarioError
from estbench.models.protocol import Channels, Model
from estbench.shapes import Array
from estbench.spaces.manifold import Manifold


@dataclass(frozen=True)
class ScaledNoise:
    """The model with its Q times `q` and its R times `r`; both scales are positive.

    Raises:
        ScenarioError: a scale is not positive.
    """

    model: Model
    q: float = 1.0
    r: float = 1.0

    def __post_init__(self) -> None:
        for name, value in (("q", self.q), ("r", self.r)):
            if not 0 < value < np.inf:
                raise ScenarioError(f"noise scale {name} is {value!r}; use a positive number")

    @property
    def space(self) -> Manifold:
        """The state's manifold."""
        return self.model.space

    @property
    def nu(self) -> int:
        """Count of controls."""
        return self.model.nu

    def output(self, channels: Channels = None) -> Manifold:
        """The measurement's manifold."""
        return self.model.output(channels)

    def transition(self, x: Array, u: Array, t: float, dt: float) -> Array:
        """The model's own f."""
        return self.model.transition(x, u, t, dt)

    def transition_jacobian(self, x: Array, u: Array, t: float, dt: float) -> tuple[Array, Array]:
        """The model's own f and Φ."""
        return self.model.transition_jacobian(x, u, t, dt)

    def process_noise(self, x: Array, u: Array, t: float, dt: float) -> Array:
        """Q q."""
        return self.q * self.model.process_noise(x, u, t, dt)

    def measurement(self, x: Array, u: Array, t: float, channels: Channels = None) -> Array:
        """The model's own h."""
        return self.model.measurement(x, u, t, channels)

    def measurement_jacobian(
        self, x: Array, u: Array, t: float, channels: Channels = None
    ) -> tuple[Array, Array]:
        """The model's own h and H."""
        return self.model.measurement_jacobian(x, u, t, channels)

    def measurement_noise(self, t: float, channels: Channels = None) -> Array:
        """R r."""
        return self.r * self.model.measurement_noise(t, channels)

    @property
    def flow(self) -> Callable[..., Array] | None:
        """The model's own ẋ, if it has one."""
        return getattr(self.model, "flow", None)

    @property
    def flow_jacobian(self) -> Callable[..., tuple[Array, Array]] | None:
        """The model's own ẋ and ∂ẋ/∂x, if it has them."""
        return getattr(self.model, "flow_jacobian", None)

    @property
    def spectral_density(self) -> Callable[..., Array] | None:
        """Q_s q, if the model has one."""
        own = getattr(self.model, "spectral_density", None)
        return own and (lambda *arguments: self.q * own(*arguments))
