"""A model with scaled noise covariances."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from estbench.errors import ScenarioError
from estbench.models.protocol import Channels, Model
from estbench.shapes import Array, Float
from estbench.spaces.manifold import Manifold


@dataclass(frozen=True)
class ScaledNoise:
    """A model with Q multiplied by `q` and R multiplied by `r`.

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
        """Number of controls."""
        return self.model.nu

    def output(self, channels: Channels = None) -> Manifold:
        """The measurement's manifold."""
        return self.model.output(channels)

    def transition(
        self, x: Float[Array, "*lead nx"], u: Float[Array, "... nu"], t: float, dt: float
    ) -> Float[Array, "*lead nx"]:
        """The transition f of the model."""
        return self.model.transition(x, u, t, dt)

    def transition_jacobian(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float, dt: float
    ) -> tuple[Float[Array, "run nx"], Float[Array, "run n n"]]:
        """The transition f and its Jacobian Φ."""
        return self.model.transition_jacobian(x, u, t, dt)

    def process_noise(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float, dt: float
    ) -> Float[Array, "... n n"]:
        """The scaled covariance q Q."""
        return self.q * self.model.process_noise(x, u, t, dt)

    def measurement(
        self,
        x: Float[Array, "*lead nx"],
        u: Float[Array, "... nu"],
        t: float,
        channels: Channels = None,
    ) -> Float[Array, "*lead ny"]:
        """The measurement h of the model."""
        return self.model.measurement(x, u, t, channels)

    def measurement_jacobian(
        self,
        x: Float[Array, "run nx"],
        u: Float[Array, "run nu"],
        t: float,
        channels: Channels = None,
    ) -> tuple[Float[Array, "run ny"], Float[Array, "run m n"]]:
        """The measurement h and its Jacobian H."""
        return self.model.measurement_jacobian(x, u, t, channels)

    def measurement_noise(self, t: float, channels: Channels = None) -> Float[Array, "... m m"]:
        """The scaled covariance r R."""
        return self.r * self.model.measurement_noise(t, channels)

    @property
    def flow(self) -> Callable[..., Array] | None:
        """ẋ of the model; None if it is not continuous."""
        return getattr(self.model, "flow", None)

    @property
    def flow_jacobian(self) -> Callable[..., tuple[Array, Array]] | None:
        """ẋ and ∂ẋ/∂x of the model; None if it is not continuous."""
        return getattr(self.model, "flow_jacobian", None)

    @property
    def spectral_density(self) -> Callable[..., Array] | None:
        """The scaled density q Q_s; None if the model is not continuous."""
        own = getattr(self.model, "spectral_density", None)
        return own and (lambda *arguments: self.q * own(*arguments))
