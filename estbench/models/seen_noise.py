"""A model whose sensors see the process noise: the noise of the last interval joins the state.

x⁺ = f(x, u) ⊞ Γ w, y = h(x, u, D w) ⊞ v, where w ~ N(0, I) is constant over the interval at whose
end y is read. The reading's error, of h(x, u, 0), is then correlated with the process noise:
S = Γ (E D)ᵀ with E = ∂h/∂(D w). With the disturbance of the last interval d = D w as a further part
of the state, the noise (Γ w, D w) is white and not correlated with v, so that every estimator is
one for correlated noise, exactly (Simon, Optimal State Estimation, 2006, sec. 7.1 and 7.2).
"""

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np

from estbench.models.differences import Differences
from estbench.models.protocol import Channels, Model
from estbench.shapes import Array, Float
from estbench.spaces.manifold import Manifold, product


@runtime_checkable
class DisturbedModel(Model, Protocol):
    """A model that can say what its sensors read under a disturbance."""

    @property
    def differences(self) -> Differences:
        """Scheme and step of the Jacobians."""
        ...

    @property
    def disturbances(self) -> Manifold:
        """R^k of the disturbance d, with names and units."""
        ...

    def sees_disturbance(self, channels: Channels = None) -> bool:
        """Whether any of the channels depends on d."""
        ...

    def disturbance_gain(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float, dt: float
    ) -> tuple[Float[Array, "run n rank"], Float[Array, "k rank"]]:
        """Γ and D over dt: the process noise is Γ w with Q = Γ Γᵀ, the disturbance d = D w."""
        ...

    def disturbed_measurement(
        self,
        x: Float[Array, "*lead nx"],
        d: Float[Array, "*lead k"],
        u: Float[Array, "... nu"],
        t: float,
        channels: Channels = None,
    ) -> Float[Array, "*lead ny"]:
        """h(x, u, d): the measurement without noise, under a disturbance."""
        ...


@dataclass(frozen=True, eq=False)
class SeenNoise:
    """A model with the disturbance of the last interval as further states `disturbance.NAME`.

    x_a = (x, d): x_a⁺ = (f(x, u), 0) ⊞ (Γ w, D w), y = h(x, u, d) ⊞ v. Cost: k more columns in the
    Jacobian of a measurement that sees the disturbance; 2 k more sigma points.

    Attributes:
        model: the model without them.
    """

    model: DisturbedModel
    space: Manifold = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "space", product([self.model.space, self.model.disturbances]))

    @property
    def nu(self) -> int:
        """Number of controls."""
        return self.model.nu

    @property
    def u0(self) -> Array | None:
        """The nominal control, about which a `KF` linearizes, if the model has one."""
        return getattr(self.model, "u0", None)

    def augment(
        self, mean: Float[Array, "run nx"], cov: Float[Array, "run n n"]
    ) -> tuple[Float[Array, "run nx_augmented"], Float[Array, "run n_augmented n_augmented"]]:
        """x̂₀ and P₀ with d = 0 and variance 1, which the first prediction replaces."""
        k, n = self.model.disturbances.n, self.model.space.n
        out = np.zeros((len(mean), n + k, n + k))
        out[:, :n, :n], out[:, n:, n:] = cov, np.eye(k)
        return np.concatenate([mean, np.zeros((len(mean), k))], axis=-1), out

    def output(self, channels: Channels = None) -> Manifold:
        """The measurement's manifold."""
        return self.model.output(channels)

    def transition(
        self, x: Float[Array, "*lead nx"], u: Float[Array, "... nu"], t: float, dt: float
    ) -> Float[Array, "*lead nx"]:
        """(f(x, u), 0): the disturbance of the next interval does not depend on the last."""
        state, d = self._split(x)
        moved = self.model.transition(state, u, t, dt)
        return np.concatenate([moved, np.zeros_like(d)], axis=-1)

    def transition_jacobian(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float, dt: float
    ) -> tuple[Float[Array, "run nx"], Float[Array, "run n n"]]:
        """The transition and [Φ 0; 0 0]."""
        state, d = self._split(x)
        moved, inner = self.model.transition_jacobian(state, u, t, dt)
        n = self.model.space.n
        F = np.zeros((len(x), self.space.n, self.space.n))
        F[:, :n, :n] = inner
        return np.concatenate([moved, np.zeros_like(d)], axis=-1), F

    def process_noise(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float, dt: float
    ) -> Float[Array, "... n n"]:
        """[Γ; D] [Γ; D]ᵀ."""
        gain, root = self.model.disturbance_gain(self._split(x)[0], u, t, dt)
        root = np.broadcast_to(root, (len(gain), *root.shape))
        both = np.concatenate([gain, root], axis=-2)
        return both @ both.mT

    def measurement(
        self,
        x: Float[Array, "*lead nx"],
        u: Float[Array, "... nu"],
        t: float,
        channels: Channels = None,
    ) -> Float[Array, "*lead ny"]:
        """h(x, u, d)."""
        state, d = self._split(x)
        if not self.model.sees_disturbance(channels):
            return self.model.measurement(state, u, t, channels)
        return self.model.disturbed_measurement(state, d, u, t, channels)

    def measurement_jacobian(
        self,
        x: Float[Array, "run nx"],
        u: Float[Array, "run nu"],
        t: float,
        channels: Channels = None,
    ) -> tuple[Float[Array, "run ny"], Float[Array, "run m n"]]:
        """The measurement and [∂h/∂x, ∂h/∂d]."""
        if self.model.sees_disturbance(channels):
            return self.model.differences.jacobian(
                lambda points: self.measurement(points, u, t, channels),
                self.space, self.output(channels), x,
            )  # fmt: skip
        y, inner = self.model.measurement_jacobian(self._split(x)[0], u, t, channels)
        H = np.zeros((*inner.shape[:-1], self.space.n))
        H[..., : inner.shape[-1]] = inner
        return y, H

    def measurement_noise(self, t: float, channels: Channels = None) -> Float[Array, "... m m"]:
        """R."""
        return self.model.measurement_noise(t, channels)

    def _split(self, x: Array) -> tuple[Array, Array]:
        """State and disturbance."""
        nx = self.model.space.nx
        return x[..., :nx], x[..., nx:]
