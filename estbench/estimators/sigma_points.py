"""Sigma-point rules: unit points and weights, and the moments of their images on a manifold."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from estbench.shapes import Array, Float
from estbench.spaces import fused
from estbench.spaces.linalg import surely_finite
from estbench.spaces.manifold import Manifold
from estbench.spaces.semidefinite import psd_root


@dataclass(frozen=True, eq=False)
class SigmaPoints:
    """A cubature rule for N(0, I): Σ wᵢ g(ξᵢ) ≈ E g(ξ).

    Attributes:
        points: ξ; the same in every run, or of each run.
        mean_weights: weights of the mean; their sum is 1.
        cov_weights: weights of the covariance.
    """

    points: Float[Array, "*run point n"]
    mean_weights: Float[Array, " point"]
    cov_weights: Float[Array, " point"]

    def draw(
        self, space: Manifold, mean: Float[Array, "run nx"], lower: Float[Array, "run n n"]
    ) -> Float[Array, "run point nx"]:
        """The points x̂ ⊞ L ξ for a factor L of P."""
        return space.plus(mean[:, None], self.points @ lower.mT)

    def around(
        self, space: Manifold, mean: Float[Array, "run nx"], cov: Float[Array, "run n n"]
    ) -> tuple[Float[Array, "run point nx"], Float[Array, "run point n"]]:
        """The points x̂ ⊞ L ξ, and L ξ, for a square root L of P; NaN where P has none."""
        loop = fused.drawn(mean, cov, self.points) if space.flat else None
        if loop is None:
            spread = self.points @ psd_root(cov).mT
            return space.plus(mean[:, None], spread), spread
        points, spread = loop
        if not surely_finite(spread):
            rest = ~np.isfinite(spread).all(axis=(-2, -1))
            spread[rest] = self.points @ psd_root(cov[rest]).mT
            points[rest] = mean[rest, None] + spread[rest]
        return points, spread

    def moments(
        self, space: Manifold, values: Float[Array, "run point nx"]
    ) -> tuple[Float[Array, "run nx"], Float[Array, "run point n"], Float[Array, "run n n"]]:
        """Mean of the values, their residuals from it, and their covariance."""
        values = self.on_line(space, values)
        loop = None
        if space.flat:
            loop = fused.moments(values, self.mean_weights, self.cov_weights)
        if loop is not None:
            return loop
        mean, residual = self._about_mean(space, values)
        return mean, residual, self.cross(residual, residual)

    def residuals(
        self, space: Manifold, values: Float[Array, "run point nx"]
    ) -> tuple[Float[Array, "run nx"], Float[Array, "run point n"]]:
        """Mean of the values and their residuals from it; angles are taken to `on_line` first."""
        return self._about_mean(space, self.on_line(space, values))

    def _about_mean(
        self, space: Manifold, values: Float[Array, "run point nx"]
    ) -> tuple[Float[Array, "run nx"], Float[Array, "run point n"]]:
        """Mean of values in `space.line`, and their residuals from it."""
        mean = space.line.mean(values, self.mean_weights)
        return mean, space.line.minus(values, mean[:, None])

    def on_line(
        self, space: Manifold, values: Float[Array, "run point nx"]
    ) -> Float[Array, "run point nx"]:
        """The values with each angle within π of that of the central point's value.

        Moments of angles are then those of the real line, also under a wide belief, while the
        values are within π of the central one, and at any width where the function does not wrap.
        A rule without a point at the centre takes the mean direction instead.
        """
        if not space.angles:
            return values
        at = self.centre
        centre = values[:, at] if at >= 0 else space.mean(values, self.mean_weights)
        return space.unwrapped(values, centre)

    @cached_property
    def centre(self) -> int:
        """Index of the point at the centre; -1 where there is none."""
        size = np.abs(self.points).max(axis=-1)
        norm = size.reshape(-1, size.shape[-1]).max(axis=0)  # over the runs, if each has its own
        return int(norm.argmin()) if norm.min() < 1e-12 else -1

    def cross(
        self, a: Float[Array, "run point n"], b: Float[Array, "run point m"]
    ) -> Float[Array, "run n m"]:
        """Σ wᵢ aᵢ bᵢᵀ of two sets of residuals."""
        return (a * self.cov_weights[:, None]).mT @ b

    def regress(
        self, residual: Float[Array, "run point m"], cov: Float[Array, "run m m"]
    ) -> tuple[Float[Array, "run m n"], Float[Array, "run m m"]]:
        """Slope A of the linear regression of values on ξ, and the covariance Ω of its residuals.

        A = Σ wᵢ rᵢ ξᵢᵀ, Ω = Σ wᵢ rᵢ rᵢᵀ - A Aᵀ: of all linear functions of ξ the one with the least
        mean square error, and that error (Lefebvre, Bruyninckx & De Schutter 2002).

        Args:
            residual: the values' residuals r.
            cov: their covariance.
        """
        slope = (residual * self.cov_weights[:, None]).mT @ self.points
        return slope, cov - slope @ slope.mT


def scaled(n: int, alpha: float = 1.0, beta: float = 2.0, kappa: float = 0.0) -> SigmaPoints:
    """The scaled unscented rule with 2 n + 1 points (van der Merwe 2004, eq. 3.11-3.13).

    λ = α² (n + κ) - n; the points are 0 and ± sqrt(n + λ) eᵢ. The mean weight of the centre is
    λ/(n + λ), its covariance weight λ/(n + λ) + 1 - α² + β.
    """
    spread = alpha**2 * (n + kappa)  # n + λ
    root = np.sqrt(spread) * np.eye(n)
    mean_weights = np.full(2 * n + 1, 0.5 / spread)
    mean_weights[0] = 1.0 - n / spread
    cov_weights = mean_weights.copy()
    cov_weights[0] += 1.0 - alpha**2 + beta
    return SigmaPoints(np.concatenate([np.zeros((1, n)), root, -root]), mean_weights, cov_weights)


def cubature(n: int) -> SigmaPoints:
    """The third-degree spherical-radial rule (Arasaratnam & Haykin 2009).

    2 n points ± sqrt(n) eᵢ of equal weight 1/(2 n).
    """
    return symmetric(np.eye(n)[None])


def symmetric(axes: Float[Array, "*run set n n"], centre_weight: float = 0.0) -> SigmaPoints:
    """The mean of third-degree rules whose points lie on orthogonal axes, ± r uᵢ of equal weight.

    r² = n/(1 - w₀), with w₀ the weight of the centre: second moments are exact for every w₀ < 1.

    Args:
        axes: the uᵢ as the rows of orthogonal matrices, one for each rule.
        centre_weight: w₀; at 0 there is no point at the centre.
    """
    count, n = axes.shape[-3:-1]
    axes = np.sqrt(n / (1.0 - centre_weight)) * axes
    axes = axes.reshape(*axes.shape[:-3], count * n, n)
    points = [axes, -axes]
    weights = np.full(2 * count * n, (1.0 - centre_weight) / (2 * count * n))
    if centre_weight:
        points = [np.zeros((*axes.shape[:-2], 1, n)), *points]
        weights = np.concatenate([[centre_weight], weights])
    return SigmaPoints(np.concatenate(points, axis=-2), weights, weights)


def gauss_hermite(n: int, order: int) -> SigmaPoints:
    """The product of `order`-point Gauss-Hermite rules (Ito & Xiong 2000).

    orderⁿ points; exact for polynomials of degree 2 order - 1 in each coordinate.
    """
    nodes, weights = np.polynomial.hermite_e.hermegauss(order)
    choice = np.indices((order,) * n).reshape(n, -1).T
    weights = (weights / weights.sum())[choice].prod(axis=-1)
    return SigmaPoints(nodes[choice], weights, weights)
