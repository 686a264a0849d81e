"""Jacobians by finite differences in the tangent space, with all perturbations in one call."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from estbench.errors import ScenarioError
from estbench.shapes import Array, Float
from estbench.spaces.linalg import constant, surely_finite
from estbench.spaces.manifold import Manifold

_EPS = float(np.finfo(np.float64).eps)
_ROUNDING = 1e-7
"""Relative rounding error of a difference quotient above which larger steps are tried."""


@dataclass(frozen=True)
class Differences:
    """Scheme, `forward` (n + 1 evaluations) or `centered` (2 n + 1), and step of the differences.

    The step is in the unit of the tangent coordinate. The error of forward differences is O(step),
    that of centered ones O(step²), plus rounding of order 1e-16 |x|/step. Where a coordinate is so
    large that rounding would exceed 1e-7 (|x| above 4500 for a step of 1e-5), larger steps are
    tried too, and each element is taken from the largest one at which the function is still linear.
    """

    scheme: Literal["forward", "centered"] = "forward"
    step: float = 1e-6

    def __post_init__(self) -> None:
        if self.scheme not in ("forward", "centered"):
            raise ScenarioError(f"scheme is '{self.scheme}'; use 'forward' or 'centered'")
        if not 0 < self.step < 1:
            raise ScenarioError(f"difference step is {self.step}; use a value in (0, 1), say 1e-6")

    def directions(self, n: int) -> Float[Array, "point n"]:
        """Tangent perturbations; the first is zero."""
        return _directions(n, self.step, self.scheme, tuple(range(n)))

    def slope(
        self, space: Manifold, values: Float[Array, "run point ny"], step: float | None = None
    ) -> Float[Array, "run m n"]:
        """Jacobian from the values of a function at the `directions`, or at those of a `step`."""
        change = space.minus(values[:, 1:], values[:, :1])
        if self.scheme == "centered":
            n = change.shape[1] // 2
            change = 0.5 * (change[:, :n] - change[:, n:])
        return change.mT / constant(self.step if step is None else step)

    def jacobian(
        self,
        function: Callable[[Array], Array],
        source: Manifold,
        target: Manifold,
        x: Float[Array, "run nx"],
        reach: int | None = None,
        units: tuple[int, ...] = (),
    ) -> tuple[Float[Array, "run ny"], Float[Array, "run m n"]]:
        """Value and Jacobian of a function at x.

        A component that is infinite at x or at one of its perturbations (a sensor without a return)
        is infinite in the value, and its row of the Jacobian is zero.

        Args:
            function: takes points `(run, point, nx)`, returns values `(run, point, ny)`.
            source: space of x.
            target: space of the value.
            x: where the Jacobian is taken.
            reach: the function depends on the first `reach` tangent coordinates only; the other
                columns are zero and are not computed. Default: all.
            units: coordinates with a column that is known: that of the identity.
        """
        n = source.n
        columns = _columns(n if reach is None else reach, units)
        values = function(source.plus(x[:, None], _directions(n, self.step, self.scheme, columns)))
        value, slope = values[:, 0], self.slope(target, values)
        limit = self.step * _ROUNDING / _EPS
        # The sum is cheap and bounds every coordinate; the second test decides.
        if not (x.size < 4096 and np.vdot(x, x) <= limit * limit) and (np.abs(x) > limit).any():
            slope = self._widened(function, source, target, x, value, slope, columns)
        if not surely_finite(slope):
            value = np.where(np.isinf(values).any(axis=1), np.inf, value)
            slope = np.where(target.infinite(value)[..., None], 0.0, slope)
        if len(columns) == n:
            return value, slope
        if units:  # in memory as a slope without them, so that products round alike
            whole = np.zeros((*slope.shape[:-2], n, slope.shape[-2]))
            whole[..., columns, :] = slope.mT
            whole[..., units, units] = 1.0
            return value, whole.mT
        out = np.zeros((*slope.shape[:-1], n))
        out[..., columns] = slope
        return value, out

    def _widened(
        self,
        function: Callable[[Array], Array],
        source: Manifold,
        target: Manifold,
        x: Array,
        value: Array,
        slope: Array,
        columns: tuple[int, ...],
    ) -> Array:
        """The Jacobian of large coordinates, by steps that their rounding errors do not hide.

        Rounding errs by e/h with e of order 1e-16 (|f| + |J| |x|). The step h grows by factors of
        16 until that is below 1e-7 of the largest coordinate. An element goes along while its
        change is within the rounding errors of the smaller step; beyond that the function bends.
        """
        inputs, outputs = source.magnitude(x)[:, columns, None], target.magnitude(value)[..., None]
        largest = np.maximum(inputs.max(axis=(1, 2)), outputs.max(axis=(1, 2)))
        needed = np.where(np.isfinite(largest), largest, 0.0) * _EPS / _ROUNDING
        step, open_ = self.step, np.ones(slope.shape, bool)
        while open_.any() and (step < needed).any():
            error = 4.0 * _EPS / step  # of the smaller step
            open_ &= (step < needed)[:, None, None]
            step *= 16.0
            points = source.plus(x[:, None], _directions(source.n, step, self.scheme, columns))
            wider = self.slope(target, function(points), step)
            size = outputs + np.maximum(np.abs(slope), np.abs(wider)) @ inputs
            open_ &= np.abs(wider - slope) <= 2.0 * error * size
            slope = np.where(open_, wider, slope)
        return slope


@lru_cache(maxsize=64)
def _columns(reach: int, units: tuple[int, ...]) -> tuple[int, ...]:
    """The tangent coordinates along which differences are taken."""
    return tuple(i for i in range(reach) if i not in units)


@lru_cache(maxsize=64)
def _directions(n: int, step: float, scheme: str, columns: tuple[int, ...]) -> Array:
    axes = step * np.eye(n)[list(columns)]
    parts = [np.zeros((1, n)), axes] + ([-axes] if scheme == "centered" else [])
    out = np.concatenate(parts)
    out.flags.writeable = False  # it is shared
    return out
