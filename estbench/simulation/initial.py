"""The true states at the start: drawn from N(x̂₀, P₀), then moved to meet the constraints."""

from dataclasses import dataclass, replace
from typing import Literal

import mujoco
import numpy as np

from estbench.robots.feasible import Feasible, has_equalities
from estbench.shapes import Array, Float
from estbench.spaces.linalg import row_product, solve_lower
from estbench.spaces.manifold import Manifold
from estbench.spaces.semidefinite import psd_root

Constraints = Literal["none", "equality", "all"]
_DRAWS = 1000


@dataclass(frozen=True, eq=False)
class InitialStates:
    """How the states at the start are drawn.

    Attributes:
        mean: centre of the draws `(nx,)`.
        factor: square root of their covariance.
        constraints: those that a drawn state is moved to meet.
    """

    mean: Float[Array, " nx"]
    factor: Float[Array, "n n"]
    constraints: Constraints = "none"

    @classmethod
    def build(
        cls,
        model: mujoco.MjModel,
        space: Manifold,
        mean: Float[Array, " nx"],
        cov: Float[Array, "n n"],
        constraints: Constraints,
    ) -> "InitialStates":
        """Draws about the mean, which is itself moved to meet the constraints.

        Where deep contacts cannot be resolved at the mean they are left alone in all draws.
        """
        if constraints == "all":
            feasible = Feasible(model, space, contacts=True)
            if not feasible.resolves_contacts(mean[None]).all():
                constraints = "equality" if has_equalities(model) else "none"
            feasible.close()
        made = cls(mean, psd_root(cov), constraints)
        if constraints == "none":
            return made
        return replace(made, mean=made.drawn(model, space, np.zeros((1, space.n)))[0])

    def drawn(
        self, model: mujoco.MjModel, space: Manifold, white: Float[Array, "row n"]
    ) -> Float[Array, "row nx"]:
        """States from standard normals."""
        sampler = self.sampler(model, space)
        try:
            return sampler(white)
        finally:
            sampler.close()

    def sampler(self, model: mujoco.MjModel, space: Manifold) -> "Sampler":
        """What draws them; not to be shared between threads."""
        feasible = None
        if self.constraints != "none":
            feasible = Feasible(model, space, contacts=self.constraints == "all")
        return Sampler(space, self.mean, self.factor, feasible)

    def moments(
        self, model: mujoco.MjModel, space: Manifold
    ) -> tuple[Float[Array, " nx"], Float[Array, "n n"]]:
        """x̂₀ and P₀: mean and covariance of the states that are drawn.

        P₀ has no variance across the constraints but for their curvature. Where states are moved
        the moments are those of a sample whose standard normals have mean zero and covariance I
        exactly, so that a linear change is exact.
        """
        cov = self.factor @ self.factor.T
        if self.constraints == "none":
            return self.mean, cov
        white = _exact_normals(max(_DRAWS, 4 * space.n), space.n)
        x = self.drawn(model, space, white)
        if np.array_equal(x, space.plus(self.mean, row_product(white, self.factor))):
            return self.mean, cov
        weights = np.full(len(x), 1.0 / len(x))
        mean = space.mean(x, weights)
        errors = space.minus(x, mean)
        return mean, errors.T @ errors / len(x)


@dataclass(frozen=True, eq=False)
class Sampler:
    """Draws states from standard normals."""

    space: Manifold
    mean: Float[Array, " nx"]
    factor: Float[Array, "n n"]
    feasible: Feasible | None

    def __call__(self, white: Float[Array, "row n"]) -> Float[Array, "row nx"]:
        """x̂₀ ⊞ S w with S Sᵀ = P₀, moved to meet the constraints."""
        x = self.space.plus(self.mean, row_product(white, self.factor))
        return x if self.feasible is None else self.feasible.project(x)

    def close(self) -> None:
        """Release the backends."""
        if self.feasible is not None:
            self.feasible.close()


def _exact_normals(count: int, n: int) -> Float[Array, "count n"]:
    """Normals whose sample has mean zero and covariance I, the same at every call."""
    white = np.random.default_rng(0).standard_normal((count, n))
    white -= white.mean(axis=0)
    return solve_lower(np.linalg.cholesky(white.T @ white / count), white.T).T
