"""A model linearized at true states, in the tangents there.

The tangent at the end of an interval is that at the true state, which the noise has moved away from
f(x, u): the Jacobians are carried to it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from estbench.models.protocol import Channels, Model
from estbench.shapes import Array, Float
from estbench.spaces.manifold import Manifold, carry
from estbench.spaces.semidefinite import psd_root


@runtime_checkable
class WhiteNoises(Protocol):
    """A model that knows of which independent noises its process noise consists."""

    def noise_response(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float, dt: float
    ) -> Float[Array, "... n k"]:
        """G with G Gᵀ = Q: the response to a unit of each; one, or one per run."""
        ...


class Linearized(Protocol):
    """What the bound asks of a system; the state may have more coordinates than the model's."""

    def transition(
        self,
        x: Float[Array, "run nx"],
        after: Float[Array, "run nx"],
        u: Float[Array, "run nu"],
        t: float,
        dt: float,
    ) -> tuple[Float[Array, "run n n"], Float[Array, "... n k"]]:
        """F and G of the interval [t, t + dt] from the true state x to the true state `after`."""
        ...

    def measurement(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float, channels: Channels
    ) -> tuple[Float[Array, "run ny"], Float[Array, "run m n"], Float[Array, "... m m"]]:
        """Noise-free readings at the true state x, H, and the inverse of the information of v."""
        ...

    def output(self, channels: Channels) -> Manifold:
        """The manifold of the readings."""
        ...


@dataclass(frozen=True)
class Linearization:
    """A model, and parameters of it that are unknown: further coordinates, constant in each run.

    F is taken without the noise of the interval, which changes it by terms of second order where
    the noise is not additive.

    Attributes:
        model: of the truth.
        varied: for each parameter the model with this parameter changed.
        change: by which each is changed, in units of its standard deviation.
    """

    model: Model
    varied: Sequence[Model] = ()
    change: float = 1e-4

    def transition(
        self,
        x: Float[Array, "run nx"],
        after: Float[Array, "run nx"],
        u: Float[Array, "run nu"],
        t: float,
        dt: float,
    ) -> tuple[Float[Array, "run _ _"], Float[Array, "... _ k"]]:
        """F and G; G is that of `WhiteNoises`, else a square root of Q."""
        f, F = self.model.transition_jacobian(x, u, t, dt)
        if isinstance(self.model, WhiteNoises):
            G = self.model.noise_response(x, u, t, dt)
        else:
            G = psd_root(self.model.process_noise(x, u, t, dt))
        space = self.model.space
        if self.varied:
            ends = np.stack([model.transition(x, u, t, dt) for model in self.varied], axis=1)
            slope = space.minus(ends, f[:, None]).mT / self.change
            F = np.concatenate([F, slope], axis=-1)
        if not space.flat:
            F, G = carry(space, space.minus(after, f), F, G)
        return (F, G) if not self.varied else (_with_constants(F), _with_rows(G, len(self.varied)))

    def measurement(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float, channels: Channels
    ) -> tuple[Float[Array, "run ny"], Float[Array, "run m _"], Float[Array, "... m m"]]:
        """Noise-free readings, H and R."""
        y, H = self.model.measurement_jacobian(x, u, t, channels)
        if self.varied:
            read = [model.measurement(x, u, t, channels) for model in self.varied]
            change = self.output(channels).minus(np.stack(read, axis=1), y[:, None])
            H = np.concatenate([H, change.mT / self.change], axis=-1)
        return y, H, self.model.measurement_noise(t, channels)

    def output(self, channels: Channels) -> Manifold:
        """The manifold of the readings."""
        return self.model.output(channels)


def _with_constants(F: Float[Array, "run n k"]) -> Float[Array, "run k k"]:
    """[F; 0 I]: further coordinates that do not change."""
    n, k = F.shape[-2:]
    rest = np.broadcast_to(np.eye(k)[n:], (len(F), k - n, k))
    return np.concatenate([F, rest], axis=-2)


def _with_rows(G: Float[Array, "... n k"], count: int) -> Float[Array, "... _ k"]:
    """[G; 0]: further coordinates without noise."""
    return np.concatenate([G, np.zeros((*G.shape[:-2], count, G.shape[-1]))], axis=-2)
