"""The random disturbance of a MuJoCo model, as the truth draws it and as Q of the filter.

Over an interval dt the disturbance is N(0, ·) with covariance made from the spectral density Q_s:

- `additive`: w ~ N(0, Q_s dt) in the tangent, x ⊞ w at the end of the interval; Q is exact.
- `force`: generalized forces ~ N(0, Q_s/dt), constant over the interval.
- `actuator`: N(0, Q_s/dt) added to the clamped controls, constant over the interval.

For the last two Q = Γ Γᵀ, where column j of Γ is the change of the end state under the j-th column
of a factor of Q_s/dt: the response of the model to one standard deviation of the disturbance. In
continuous time (`intensity`) it is G Q_s Gᵀ, with G = ∂ẋ/∂w.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from estbench.errors import CovarianceError, DimensionError
from estbench.robots.backend import Backend
from estbench.robots.layout import control_names
from estbench.shapes import Array, Float, Int
from estbench.spaces.linalg import added_first, is_positive_semidefinite, rescaled, row_product
from estbench.spaces.manifold import Manifold
from estbench.spaces.patterns import expand
from estbench.spaces.semidefinite import eigen_root

Kind = Literal["additive", "force", "actuator"]


@dataclass(frozen=True, eq=False)
class Disturbance:
    """Kind and spectral density of a disturbance.

    Attributes:
        kind: where it enters.
        density: Q_s; k = n, nv or nu by kind.
        factor: a square root of Q_s, its nonzero columns only.
        schedule: a function of the time at the start of the interval. It returns a factor on Q_s
            (one, or one per coordinate `(k,)`: Q_s becomes D Q_s D with D² the factors), or Q_s
            itself `(k, k)`. None: Q_s is constant.
        scale: factor on Q_s where the schedule returns Q_s itself.
    """

    kind: Kind
    density: Float[Array, "k k"]
    factor: Float[Array, "k rank"]
    schedule: Callable[[float], float | Array] | None = None
    scale: float = 1.0

    @classmethod
    def build(
        cls,
        model: mujoco.MjModel,
        space: Manifold,
        kind: Kind,
        density: float | Sequence[float] | dict[str, float] = 0.0,
        matrix: Sequence[Sequence[float]] | None = None,
        where: str = "process_noise",
    ) -> "Disturbance":
        """From a diagonal `density` per name, or a full `matrix`; `where` is for messages.

        Raises:
            DimensionError: wrong number of values.
            CovarianceError: a density is negative or the matrix not positive semidefinite.
        """
        names = axis_names(model, space, kind)
        if matrix is None:
            values = expand(density, names, f"{where}.density")
            if (values < 0).any():
                raise CovarianceError(
                    f"{where}.density is negative for {names[int(values.argmin())]}: "
                    f"{values.min():g}; a spectral density is at least 0"
                )
            Q = np.diag(values)
        else:
            Q = np.asarray(matrix, dtype=np.float64)
            if Q.shape != (len(names), len(names)):
                raise DimensionError(
                    f"{where}.matrix has shape {Q.shape}; expected "
                    f"{(len(names), len(names))} for kind '{kind}' ({', '.join(names)})"
                )
            if not is_positive_semidefinite(Q):
                raise CovarianceError(f"{where}.matrix is not symmetric positive semidefinite")
        factor = eigen_root(Q)[0]
        return cls(kind, Q, factor[:, np.abs(factor).max(axis=0, initial=0.0) > 0])

    @property
    def rank(self) -> int:
        """Number of independent white noises."""
        return self.factor.shape[1]

    def scaled(self, scale: float) -> "Disturbance":
        """The disturbance with Q_s multiplied by `scale`."""
        return replace(
            self,
            density=scale * self.density,
            factor=np.sqrt(scale) * self.factor,
            scale=scale * self.scale,
        )

    def scheduled(self, schedule: Callable[[float], float | Array]) -> "Disturbance":
        """The disturbance with a schedule; if that gives Q_s, its value at t = 0 is the density."""
        first = schedule(0.0)
        if np.ndim(first) < 2:
            return replace(self, schedule=schedule)
        density = np.asarray(first)  # all columns: one that is zero now may not be so later
        return replace(self, density=density, factor=eigen_root(density)[0], schedule=schedule)

    def root(self, t: float) -> Float[Array, "k rank"]:
        """A square root of Q_s at t."""
        if self.schedule is None:
            return self.factor
        value = np.asarray(self.schedule(t))
        if value.ndim == 2:
            return np.sqrt(self.scale) * eigen_root(value)[0]
        return np.sqrt(value)[..., None] * self.factor

    def _density(self, t: float) -> Array:
        """Q_s at t."""
        if self.schedule is None:
            return self.density
        value = np.asarray(self.schedule(t))
        if value.ndim == 2:
            return self.scale * value
        return rescaled(self.density, np.sqrt(value))

    def sample(
        self, white: Float[Array, "run rank"], t: float | Array, dt: float | Array
    ) -> Float[Array, "run k"]:
        """The disturbance over [t, t + dt].

        Args:
            white: standard normal numbers.
            t: start of the interval, s; one number, or one per run `(run, 1)`.
            dt: length of the interval, s; as for `t`.
        """
        size = np.sqrt(dt) if self.kind == "additive" else np.sqrt(1.0 / dt)
        if self.schedule is None or isinstance(t, float):
            return row_product(white, self.root(float(np.ravel(t)[0]))) * size
        out = np.empty((len(white), len(self.density)))
        for now in np.unique(t):
            here = t[:, 0] == now
            out[here] = row_product(white[here], self.root(float(now)))
        return out * size

    def covariance(
        self,
        backend: Backend,
        space: Manifold,
        x: Float[Array, "run nx"],
        u: Float[Array, "run nu"],
        t: float,
        dt: float,
        nstep: int,
        timestep: float | None = None,
    ) -> Float[Array, "... n n"]:
        """Q over dt at x; one, or one per run."""
        if self.kind == "additive":
            return self._density(t) * dt
        if not self.rank:
            return np.zeros((space.n, space.n))
        response = self.response(backend, space, x, u, t, dt, nstep, timestep)
        return response.mT @ response

    def response(
        self,
        backend: Backend,
        space: Manifold,
        x: Float[Array, "run nx"],
        u: Float[Array, "run nu"],
        t: float,
        dt: float,
        nstep: int,
        timestep: float | None = None,
    ) -> Float[Array, "run rank n"]:
        """Γᵀ: the change of the end state under each column of `held`."""
        points, push, force = self._pushed(x, u, self.held(t, dt))
        ends = backend.step(points, push, t, nstep, force, timestep)
        return space.minus(ends[:, 1:], ends[:, :1])

    def held(self, t: float, dt: float) -> Float[Array, "k rank"]:
        """A square root of the covariance Q_s/dt of a force or control that is held over dt."""
        return self.root(t) * np.sqrt(1.0 / dt)

    @property
    def places(self) -> Int[NDArray[np.intp], " k"]:
        """Forces or controls that may be disturbed; with a schedule any may."""
        if self.schedule is not None:
            return np.arange(len(self.density))
        return np.flatnonzero(np.abs(self.factor).max(axis=1, initial=0.0))

    def intensity(
        self,
        backend: Backend,
        space: Manifold,
        x: Float[Array, "run nx"],
        u: Float[Array, "run nu"],
        t: float,
    ) -> Float[Array, "... n n"]:
        """The spectral density G Q_s Gᵀ of the noise on ẋ at x; one, or one per run.

        G is the slope of ẋ over one standard deviation of the disturbance, constant over one
        physics step. ẋ is linear in the disturbance except for contacts and the gains of some
        actuators.
        """
        if self.kind == "additive":
            return self._density(t)
        if not self.rank:
            return np.zeros((space.n, space.n))
        held = 1.0 / backend.model.opt.timestep
        points, push, force = self._pushed(x, u, self.root(t) * np.sqrt(held))
        rates = backend.flow(points, push, t, force)
        response = (rates[:, 1:] - rates[:, :1]) / np.sqrt(held)
        return response.mT @ response

    def _pushed(self, x: Array, u: Array, root: Array) -> tuple[Array, Array, Array | None]:
        """States, controls and forces: the undisturbed row, then one row per column of root."""
        columns = np.concatenate([np.zeros((1, len(root))), root.T])
        points = np.broadcast_to(x[:, None], (len(x), len(columns), x.shape[-1]))
        if self.kind == "force":
            return points, u, columns
        return points, added_first(u[:, None], columns), None


def axis_names(model: mujoco.MjModel, space: Manifold, kind: Kind) -> tuple[str, ...]:
    """Names of the axes of Q_s: tangent coordinates, velocities or actuators."""
    return {
        "additive": space.names,
        "force": space.names[model.nv : 2 * model.nv],
        "actuator": tuple(control_names(model)),
    }[kind]
