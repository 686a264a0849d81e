"""Linear-Gaussian model with feedthrough, x⁺ = A x + B u + w, y = C x + D u + v (source 003)."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from estbench.errors import DimensionError
from estbench.models.calls import matrix_at
from estbench.models.protocol import Channels
from estbench.shapes import Array, Float
from estbench.spaces.covariance import check_covariance
from estbench.spaces.manifold import Manifold


@dataclass(frozen=True, eq=False)
class LinearModel:
    """Matrices of one discrete step; they do not depend on time, so `dt` and `t` are ignored.

    Every matrix may have a leading run axis.

    Attributes:
        A: transition matrix.
        C: measurement matrix.
        Q: process noise covariance, positive semidefinite.
        R: measurement noise covariance, positive definite.
        B: control matrix; default without columns.
        D: feedthrough; default zero.
        names, units: of the state's coordinates.

    Raises:
        DimensionError: a matrix does not fit A or C, or is none of finite real numbers.
        CovarianceError: R is not symmetric positive definite, or Q not semidefinite.
    """

    A: Float[Array, "... n n"]
    C: Float[Array, "... m n"]
    Q: Float[Array, "... n n"]
    R: Float[Array, "... m m"]
    B: Float[Array, "... n nu"] | None = None
    D: Float[Array, "... m nu"] | None = None
    names: tuple[str, ...] | None = None
    units: tuple[str, ...] | None = None
    space: Manifold = field(init=False, repr=False)
    _output: Manifold = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("A", "C", "Q", "R", "B", "D"):
            given = getattr(self, name)
            if given is not None or name not in ("B", "D"):
                object.__setattr__(self, name, _matrix(name, given))
        n, m = self.A.shape[-1], self.C.shape[-2]
        B = np.zeros((n, 0)) if self.B is None else self.B
        D = np.zeros((m, B.shape[-1])) if self.D is None else self.D
        for name, value, shape in (
            ("A", self.A, (n, n)), ("C", self.C, (m, n)), ("Q", self.Q, (n, n)),
            ("R", self.R, (m, m)), ("B", B, (n, B.shape[-1])), ("D", D, (m, B.shape[-1])),
        ):  # fmt: skip
            if value.shape[-2:] != shape:
                raise DimensionError(f"{name} has shape {value.shape}; expected {shape}")
        check_covariance("Q", self.Q)
        check_covariance("R", self.R, definite=True)
        object.__setattr__(self, "B", B)
        object.__setattr__(self, "D", D)
        object.__setattr__(self, "space", Manifold.euclidean(n, self.names, self.units))
        names = tuple(f"y{i}" for i in range(m))
        object.__setattr__(self, "_output", Manifold.euclidean(m, names))

    @property
    def nu(self) -> int:
        """Number of controls."""
        assert self.B is not None
        return self.B.shape[-1]

    def output(self, channels: Channels = None) -> Manifold:
        """R^m; the model has a single channel."""
        return self._output

    def transition(
        self,
        x: Float[Array, "*lead nx"],
        u: Float[Array, "... nu"],
        t: float = 0.0,
        dt: float = 1.0,
    ) -> Float[Array, "*lead nx"]:
        """A x + B u."""
        return _affine(self.A, x, self.B, u)

    def transition_jacobian(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float = 0.0, dt: float = 1.0
    ) -> tuple[Float[Array, "run nx"], Float[Array, "run n n"]]:
        """A x + B u and A."""
        return self.transition(x, u), np.broadcast_to(self.A, (len(x), *self.A.shape[-2:]))

    def process_noise(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float = 0.0, dt: float = 1.0
    ) -> Float[Array, "... n n"]:
        """Q."""
        return self.Q

    def measurement(
        self,
        x: Float[Array, "*lead nx"],
        u: Float[Array, "... nu"],
        t: float = 0.0,
        channels: Channels = None,
    ) -> Float[Array, "*lead ny"]:
        """C x + D u."""
        return _affine(self.C, x, self.D, u)

    def measurement_jacobian(
        self,
        x: Float[Array, "run nx"],
        u: Float[Array, "run nu"],
        t: float = 0.0,
        channels: Channels = None,
    ) -> tuple[Float[Array, "run ny"], Float[Array, "run m n"]]:
        """C x + D u and C."""
        return self.measurement(x, u), np.broadcast_to(self.C, (len(x), *self.C.shape[-2:]))

    def measurement_noise(
        self, t: float = 0.0, channels: Channels = None
    ) -> Float[Array, "... m m"]:
        """R."""
        return self.R


def _affine(M: Array, x: Array, N: Array | None, u: Array) -> Array:
    """M x + N u for x `(run, n)` or `(run, point, n)` and u `(run, nu)`."""
    points = x if x.ndim == 3 else x[:, None]
    out = points @ M.mT
    if N is not None and N.shape[-1]:
        out = out + u[:, None] @ N.mT
    return out if x.ndim == 3 else out[:, 0]


def _matrix(name: str, given: Any) -> Array:
    """One matrix, or one per run, of real numbers; finite unless it is a covariance."""
    value = matrix_at(name, given)
    if value.ndim not in (2, 3):
        raise DimensionError(
            f"{name} has shape {value.shape}; expected a matrix, or one for each run (run, ., .)"
        )
    if name not in ("Q", "R") and not np.isfinite(value).all():
        raise DimensionError(f"{name} has an entry that is not finite; give real numbers")
    return value
