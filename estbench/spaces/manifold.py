"""The layout of a state or measurement space: x ⊞ δ, x ⊖ y, names and units of each coordinate.

A point has `nx` numbers, its tangent `n`; they differ by one for every unit quaternion. Errors,
covariances and NEES live in the tangent at the estimate. Rotations are body-frame, as in
`mj_integratePos` and `mj_differentiatePos`.

Source: Hertzberg et al., "Integrating generic sensor fusion algorithms with sound state
representations through encapsulation of manifolds" (2013), Table 1.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estbench.errors import DimensionError, shown
from estbench.shapes import Array, Bool, Float, Int, Mask
from estbench.spaces import rotation
from estbench.spaces.linalg import weighted


@dataclass(frozen=True, eq=False)
class Manifold:
    """A product of real lines, circles and unit quaternions.

    Attributes:
        names: name of each tangent coordinate.
        units: unit of each tangent coordinate.
        quaternions: for each quaternion, in order, its first index in the point and the first index
            of its rotation vector in the tangent. Every other coordinate is a real line or a
            circle.
        angles: tangent coordinates that are angles on a circle, in rad. A difference of angles is
            taken into [-π, π]; an angle of a point may be any real number.
        flat: whether ⊞ is plain addition.
        vector: whether ⊖ is plain subtraction too, as in R^n.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    quaternions: Int[NDArray[np.intp], "quaternion 2"] = field(
        default_factory=lambda: np.zeros((0, 2), np.intp)
    )
    angles: tuple[int, ...] = ()
    flat: bool = field(init=False, repr=False)
    vector: bool = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if len(self.names) != len(self.units):
            raise DimensionError(
                f"names has {len(self.names)} entries and units {len(self.units)}; give one each"
            )
        object.__setattr__(self, "flat", not len(self.quaternions))
        object.__setattr__(self, "vector", self.flat and not self.angles)
        taken = [i for _, first in self.quaternions for i in range(first, first + 3)]
        for i in self.angles:
            if not 0 <= i < self.n or i in taken or self.angles.count(i) > 1:
                raise DimensionError(
                    f"angles is {list(self.angles)}; use some of 0 to {self.n - 1}, each once and "
                    "none of a quaternion's"
                )
        lines, turns, start, shift = [], [], 0, 0
        for point, tangent in (
            *self.quaternions[self.quaternions[:, 0].argsort()],
            (self.nx, self.n),
        ):
            lines.append((slice(start, point), slice(start - shift, tangent)))
            start, shift = point + 4, shift + 1
            turns.append((slice(point, start), slice(tangent, tangent + 3)))
        object.__setattr__(self, "_lines", [(x, t) for x, t in lines if x.start < x.stop])
        object.__setattr__(self, "_turns", _together(turns[:-1]))
        tangent = np.array(self.angles, np.intp)
        before = (self.quaternions[:, 1] < tangent[:, None]).sum(axis=1)
        object.__setattr__(self, "_circles", (tangent + before, tangent))

    # Slices of the point and of the tangent, for runs of real lines and for one quaternion. A
    # slice is several times faster in numpy than a list of indices; several quaternions are
    # indexed together, `(quaternion, 4)` and `(quaternion, 3)`.
    _lines: list[tuple[slice, slice]] = field(init=False, repr=False)
    _turns: list[tuple[Any, Any]] = field(init=False, repr=False)
    # Indices of the angles in the point and in the tangent.
    _circles: tuple[NDArray[np.intp], NDArray[np.intp]] = field(init=False, repr=False)

    @classmethod
    def euclidean(
        cls,
        n: int,
        names: Sequence[str] | None = None,
        units: Sequence[str] | None = None,
        angles: Sequence[int] = (),
    ) -> "Manifold":
        """R^n, with circles at `angles`; default names are x0, x1, ..., the default unit is 1.

        Raises:
            DimensionError: names or units are no n texts, or angles no different indices.
        """
        for what, given in (("names", names), ("units", units)):
            if given is not None and (
                isinstance(given, str)
                or not isinstance(given, Sequence)
                or not all(isinstance(text, str) for text in given)
            ):
                raise DimensionError(f"{what} is {shown(given)}; use {n} texts")
        listed = isinstance(angles, Sequence | np.ndarray)
        if not listed or not all(isinstance(i, int | np.integer) for i in angles):
            raise DimensionError(f"angles is {shown(angles)}; use a list of some of 0 to {n - 1}")
        return cls(
            tuple(names) if names is not None else tuple(f"x{i}" for i in range(n)),
            tuple(units) if units is not None else ("1",) * n,
            angles=tuple(angles),
        )

    @property
    def n(self) -> int:
        """Dimension of the tangent space."""
        return len(self.names)

    @property
    def nx(self) -> int:
        """Number of values in a point."""
        return self.n + len(self.quaternions)

    def plus(
        self, x: Float[Array, "... nx"], delta: Float[Array, "... n"]
    ) -> Float[Array, "... nx"]:
        """The point x ⊞ δ that is reached from x along the tangent vector δ."""
        if self.flat:
            return x + delta
        out = np.empty((*np.broadcast_shapes(x.shape[:-1], delta.shape[:-1]), self.nx))
        for at, to in self._lines:
            np.add(x[..., at], delta[..., to], out=out[..., at])
        for at, to in self._turns:
            turned = rotation.multiply(_taken(x, at), rotation.exp(_taken(delta, to)))
            out[..., at] = rotation.normalize(turned)
        return out

    def minus(self, x: Float[Array, "... nx"], y: Float[Array, "... nx"]) -> Float[Array, "... n"]:
        """The tangent vector x ⊖ y at y: y ⊞ (x ⊖ y) = x."""
        if self.vector:
            return x - y
        out = np.empty((*np.broadcast_shapes(x.shape[:-1], y.shape[:-1]), self.n))
        for at, to in self._lines:
            np.subtract(x[..., at], y[..., at], out=out[..., to])
        for at, to in self._turns:
            q, p = rotation.normalize(_taken(x, at)), rotation.normalize(_taken(y, at))
            out[..., to] = rotation.log(rotation.multiply(rotation.conjugate(p), q))
        if self.angles:
            _, to = self._circles
            out[..., to] = rotation.short_way(out[..., to])
        return out

    def magnitude(self, x: Float[Array, "... nx"]) -> Float[Array, "... n"]:
        """|x| of each coordinate of the tangent; 1 for those of a rotation."""
        if self.flat:
            return np.abs(x)
        out = np.ones((*x.shape[:-1], self.n))
        for at, to in self._lines:
            np.abs(x[..., at], out=out[..., to])
        return out

    def mean(
        self, points: Float[Array, "*any point nx"], weights: Float[Array, "... point"]
    ) -> Float[Array, "*any nx"]:
        """Weighted mean of points: the m with Σ wᵢ (xᵢ ⊖ m) = 0.

        Quaternions are averaged by `rotation.mean`, angles by `rotation.mean_angle`.
        """
        mean = weighted(weights, points)
        if self.angles:
            at, _ = self._circles
            mean[..., at] = rotation.mean_angle(points[..., at], weights)
        for at, _ in self._turns:
            if isinstance(at, slice):
                mean[..., at] = rotation.mean(points[..., at], weights)
                continue
            each = weights if weights.ndim == 1 else weights[..., None, :]
            mean[..., at] = rotation.mean(np.moveaxis(_taken(points, at), -3, -2), each)
        return mean

    @cached_property
    def line(self) -> "Manifold":
        """The same coordinates, with every angle as a point of the real line."""
        return replace(self, angles=()) if self.angles else self

    def unwrapped(
        self, points: Float[Array, "*any point nx"], centre: Float[Array, "*any nx"]
    ) -> Float[Array, "*any point nx"]:
        """The points in `line`: each angle within π of that of the centre.

        Angles that differ by more than a turn are left as they are: the function that gave them
        does not wrap.
        """
        if not self.angles:
            return points
        at, _ = self._circles
        angles, middle = points[..., at], centre[..., None, at]
        wide = np.ptp(angles, axis=-2, keepdims=True) > 2 * np.pi
        out = points.copy()
        out[..., at] = np.where(wide, angles, middle + rotation.short_way(angles - middle))
        return out

    def reset_jacobian(self, delta: Float[Array, "*any n"]) -> Float[Array, "*any n n"]:
        """J = ∂((x ⊞ (δ + e)) ⊖ (x ⊞ δ))/∂e at e = 0.

        It maps a covariance from the tangent at x to the tangent at x ⊞ δ. It is the identity
        except for the right Jacobian of each rotation vector.
        """
        out = np.broadcast_to(np.eye(self.n), (*delta.shape[:-1], self.n, self.n)).copy()
        for _, to in self._turns:
            rows, columns = (to, to) if isinstance(to, slice) else (to[..., None], to[:, None])
            out[..., rows, columns] = rotation.right_jacobian(_taken(delta, to))
        return out

    def transport(
        self, cov: Float[Array, "*any n n"], delta: Float[Array, "*any n"]
    ) -> Float[Array, "*any n n"]:
        """J P Jᵀ: the covariance in the tangent at x ⊞ δ, from the covariance P at x."""
        if self.flat:
            return cov
        out = cov.copy()
        for _, turn in self._turns:  # elsewhere J is the identity
            jacobian = rotation.right_jacobian(_taken(delta, turn))
            out[..., turn, :] = jacobian @ _taken(out, turn, -2)
            columns = _taken(out, turn)
            if isinstance(turn, slice):
                out[..., turn] = columns @ jacobian.mT
            else:
                columns = np.moveaxis(columns, -2, -3) @ jacobian.mT
                out[..., turn] = np.moveaxis(columns, -3, -2)
        return out

    def infinite(self, x: Float[Array, "*any nx"]) -> Bool[Mask, "*any n"]:
        """Tangent coordinates whose number in the point is infinite; none of a quaternion."""
        if self.flat:
            return np.isinf(x)
        out = np.zeros((*x.shape[:-1], self.n), bool)
        for at, to in self._lines:
            out[..., to] = np.isinf(x[..., at])
        return out

    def index(self, name: str) -> int:
        """Position of the tangent coordinate `name`."""
        return self.names.index(name)


def _taken(a: Array, at: Any, axis: int = -1) -> Array:
    """The values of the quaternions, those of a run side by side in memory, whatever the others.

    With several quaternions an index would place the runs there, and products round otherwise than
    those of one run.
    """
    if not isinstance(at, slice):
        return a.take(at, axis=axis)
    return a[..., at] if axis == -1 else a[..., at, :]


def _together(turns: Sequence[tuple[slice, slice]]) -> list[tuple[Any, Any]]:
    """The quaternions as one pair of indices, where there are several."""
    if len(turns) < 2:
        return list(turns)
    return [tuple(np.array([range(s.start, s.stop) for s in part]) for part in zip(*turns))]  # type: ignore[list-item]


def product(spaces: Sequence[Manifold]) -> Manifold:
    """The product manifold: its points are the points of `spaces`, concatenated."""
    names, units, quaternions, nx = [], [], [np.zeros((0, 2), np.intp)], 0
    angles: list[int] = []
    for space in spaces:
        angles += [len(names) + i for i in space.angles]
        quaternions.append(space.quaternions + np.array([nx, len(names)]))
        names += space.names
        units += space.units
        nx += space.nx
    return Manifold(tuple(names), tuple(units), np.concatenate(quaternions), tuple(angles))


def carry(
    space: Manifold,
    shift: Float[Array, "run m"],
    H: Float[Array, "... m n"],
    C: Float[Array, "... m k"],
) -> tuple[Float[Array, "run m n"], Float[Array, "run m k"]]:
    """Jacobians of y ⊞ c in the tangent at y ⊞ c, from those of y and of c.

    For a rotation vector c the factors are R(c)ᵀ = I - [c]× J_r(c) on H and J_r(c) on C (Solà 2017,
    eq. 183).

    Args:
        space: the manifold of y.
        shift: the value of c.
        H: Jacobian of y.
        C: Jacobian of c.
    """
    jacobian = space.reset_jacobian(shift)
    turn = np.broadcast_to(np.eye(space.n), jacobian.shape).copy()
    for start in space.quaternions[:, 1]:
        block = slice(start, start + 3)
        turn[..., block, block] -= rotation.skew(shift[..., block]) @ jacobian[..., block, block]
    return turn @ H, jacobian @ C
