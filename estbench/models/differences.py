"""Jacobians by finite differences in the tangent space, all perturbations as rows of one call."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from estbench.errors import ScenarioError
from estbench.shapes import Array
from estbench.spaces.manifold import Manifold


@dataclass(frozen=True)
class Differences:
    """How to difference: `forward` (n + 1 evaluations) or `centered` (2 n + 1), and the step size.

    The step is in the tangent coordinate's own unit. Forward differences err by O(step), centered
    ones by O(step²) plus rounding of order 1e-16/step.
    """

    scheme: Literal["forward", "centered"] = "forward"
    step: float = 1e-6

    def __post_init__(self) -> None:
        if self.scheme not in ("forward", "centered"):
            raise ScenarioError(f"scheme is '{self.scheme}'; use 'forward' or 'centered'")
        if not 0 < self.step < 1:
            raise ScenarioError(f"difference step is {self.step}; use a value in (0, 1), say 1e-6")

    def directions(self, n: int) -> Array:
        """Tangent perturbations `(point, n)`; the first is zero."""
        return _directions(n, self.step, self.scheme, n)

    def slope(self, space: Manifold, values: Array) -> Array:
        """Jacobian `(run, m, n)` from values `(run, point, ny)` at the `directions`."""
        change = space.minus(values[:, 1:], values[:, :1])
        if self.scheme == "centered":
            n = change.shape[1] // 2
            change = 0.5 * (change[:, :n] - change[:, n:])
        return change.mT / self.step

    def jacobian(
        self,
        function: Callable[[Array], Array],
        source: Manifold,
        target: Manifold,
        x: Array,
        reach: int | None = None,
    ) -> tuple[Array, Array]:
        """Value `(run, ny)` and Jacobian `(run, m, n)` of a function of `(run, point, nx)` at x.

        `reach`: how many tangent coordinates, from the first on, the function depends on; the
        other columns are zero and cost nothing.
        """
        n = source.n
        reach = n if reach is None else reach
        values = function(source.plus(x[:, None], _directions(n, self.step, self.scheme, reach)))
        slope = self.slope(target, values)
        if reach == n:
            return values[:, 0], slope
        out = np.zeros((*slope.shape[:-1], n))
        out[..., :reach] = slope
        return values[:, 0], out


@lru_cache(maxsize=64)
def _directions(n: int, step: float, scheme: str, reach: int) -> Array:
    axes = step * np.eye(n)[:reach]
    parts = [np.zeros((1, n)), axes] + ([-axes] if scheme == "centered" else [])
    out = np.concatenate(parts)
    out.flags.writeable = False  # it is shared
    return out
