"""Linear-Gaussian model with feedthrough, x⁺ = A x + B u + w, y = C x + D u + v (source 003)."""

from dataclasses import dataclass, field

import numpy as np

from estbench.errors import CovarianceError, DimensionError
from estbench.models.protocol import Channels
from estbench.shapes import Array
from estbench.spaces.linalg import is_positive_definite
from estbench.spaces.manifold import Manifold


@dataclass(frozen=True, eq=False)
class LinearModel:
    """Matrices of one discrete step; the model's step has no length, so `dt` and `t` are ignored.

    Attributes:
        A: `(n, n)`, or `(run, n, n)` for one matrix a run; likewise the others.
        C: `(m, n)`.
        Q: process noise covariance `(n, n)`, positive semidefinite.
        R: measurement noise covariance `(m, m)`, positive definite.
        B: `(n, nu)`, zero columns by default.
        D: feedthrough `(m, nu)`, zero by default.
        names, units: of the state's coordinates.

    Raises:
        DimensionError: a matrix does not fit A or C.
        CovarianceError: R is not symmetric positive definite.
    """

    A: Array
    C: Array
    Q: Array
    R: Array
    B: Array | None = None
    D: Array | None = None
    names: tuple[str, ...] | None = None
    units: tuple[str, ...] | None = None
    space: Manifold = field(init=False, repr=False)
    _output: Manifold = field(init=False, repr=False)

    def __post_init__(self) -> None:
        n, m = self.A.shape[-1], self.C.shape[-2]
        B = np.zeros((n, 0)) if self.B is None else self.B
        D = np.zeros((m, B.shape[-1])) if self.D is None else self.D
        for name, value, shape in (
            ("A", self.A, (n, n)), ("C", self.C, (m, n)), ("Q", self.Q, (n, n)),
            ("R", self.R, (m, m)), ("B", B, (n, B.shape[-1])), ("D", D, (m, B.shape[-1])),
        ):  # fmt: skip
            if value.shape[-2:] != shape:
                raise DimensionError(f"{name} has shape {value.shape}; expected {shape}")
        if self.R.ndim == 2 and not is_positive_definite(self.R):
            raise CovarianceError("R is not symmetric positive definite; raise its eigenvalues")
        object.__setattr__(self, "B", B)
        object.__setattr__(self, "D", D)
        object.__setattr__(self, "space", Manifold.euclidean(n, self.names, self.units))
        names = tuple(f"y{i}" for i in range(m))
        object.__setattr__(self, "_output", Manifold.euclidean(m, names))

    @property
    def nu(self) -> int:
        """Count of controls."""
        assert self.B is not None
        return self.B.shape[-1]

    def output(self, channels: Channels = None) -> Manifold:
        """R^m; a linear model has one channel."""
        return self._output

    def transition(self, x: Array, u: Array, t: float = 0.0, dt: float = 1.0) -> Array:
        """A x + B u."""
        return _affine(self.A, x, self.B, u)

    def transition_jacobian(
        self, x: Array, u: Array, t: float = 0.0, dt: float = 1.0
    ) -> tuple[Array, Array]:
        """A x + B u and A."""
        return self.transition(x, u), np.broadcast_to(self.A, (len(x), *self.A.shape[-2:]))

    def process_noise(self, x: Array, u: Array, t: float = 0.0, dt: float = 1.0) -> Array:
        """Q."""
        return self.Q

    def measurement(self, x: Array, u: Array, t: float = 0.0, channels: Channels = None) -> Array:
        """C x + D u."""
        return _affine(self.C, x, self.D, u)

    def measurement_jacobian(
        self, x: Array, u: Array, t: float = 0.0, channels: Channels = None
    ) -> tuple[Array, Array]:
        """C x + D u and C."""
        return self.measurement(x, u), np.broadcast_to(self.C, (len(x), *self.C.shape[-2:]))

    def measurement_noise(self, t: float = 0.0, channels: Channels = None) -> Array:
        """R."""
        return self.R


def _affine(M: Array, x: Array, N: Array | None, u: Array) -> Array:
    """M x + N u for x `(run, n)` or `(run, point, n)` and u `(run, nu)`."""
    points = x if x.ndim == 3 else x[:, None]
    out = points @ M.mT
    if N is not None and N.shape[-1]:
        out = out + u[:, None] @ N.mT
    return out if x.ndim == 3 else out[:, 0]
