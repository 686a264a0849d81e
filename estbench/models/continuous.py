"""Continuous-time models ẋ = f(x) + G u + w, and their integration by RK4 on a manifold."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np

from estbench.errors import DimensionError
from estbench.models.calls import Matrix, matrix_at
from estbench.models.differences import Differences
from estbench.models.function import Function, FunctionModel
from estbench.models.protocol import Channels, Model
from estbench.shapes import Array, Float
from estbench.spaces import rotation
from estbench.spaces.covariance import check_covariance
from estbench.spaces.linalg import symmetrize
from estbench.spaces.manifold import Manifold


@runtime_checkable
class ContinuousModel(Model, Protocol):
    """A model that also gives its rate ẋ, for filters that integrate it (Bishop, eq. 1)."""

    def flow(
        self, x: Float[Array, "*lead nx"], u: Float[Array, "... nu"], t: float
    ) -> Float[Array, "*lead n"]:
        """ẋ in the tangent at x; for a rotation the body-frame angular rate."""
        ...

    def flow_jacobian(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float
    ) -> tuple[Float[Array, "run n"], Float[Array, "run n n"]]:
        """ẋ and ∂ẋ(x ⊞ δ)/∂δ at δ = 0, without the rotation of the tangent itself."""
        ...

    def spectral_density(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float
    ) -> Float[Array, "... n n"]:
        """Q_s of the white noise on ẋ; one, or one per run."""
        ...


def integrate(
    model: ContinuousModel,
    x: Float[Array, "*lead nx"],
    u: Float[Array, "... nu"],
    t: float,
    dt: float,
    substeps: int = 1,
) -> Float[Array, "*lead nx"]:
    """The state after dt by RK4. Cost: 4 `substeps` flows."""
    for start, h in _grid(t, dt, substeps):

        def slope(s: float, state: tuple[Array, ...], x: Array = x) -> tuple[Array, ...]:
            rate = model.flow(model.space.plus(x, state[0]), u, s)
            return (chart_rate(model.space, state[0], rate),)

        (delta,) = _rk4(slope, start, h, (np.zeros((*x.shape[:-1], model.space.n)),))
        x = model.space.plus(x, delta)
    return x


def integrate_moments(
    model: ContinuousModel,
    x: Float[Array, "run nx"],
    u: Float[Array, "run nu"],
    t: float,
    dt: float,
    substeps: int = 1,
) -> tuple[Float[Array, "run nx"], Float[Array, "run n n"], Float[Array, "run n n"]]:
    """State, Φ and Q̄ after dt, integrated together by RK4 (Bishop, eq. 10).

    The tangent increment from the start of each substep is integrated. Φ maps the tangent at the
    first x to that at the current x; Q̄ is in the latter. Cost: 4 `substeps` flow Jacobians.
    """
    n = model.space.n
    Phi = np.broadcast_to(np.eye(n), (len(x), n, n))
    Q = np.zeros((len(x), n, n))
    for start, h in _grid(t, dt, substeps):

        def slope(s: float, state: tuple[Array, ...], x: Array = x) -> tuple[Array, ...]:
            return moment_rates(model, x, u, s, *state)

        delta, Phi, Q = _rk4(slope, start, h, (np.zeros((len(x), n)), Phi, Q))
        x = model.space.plus(x, delta)
    return x, Phi, symmetrize(Q)


def moment_rates(
    model: ContinuousModel,
    x: Float[Array, "run nx"],
    u: Float[Array, "run nu"],
    t: float,
    delta: Float[Array, "run n"],
    Phi: Float[Array, "run n n"],
    Q: Float[Array, "run n n"],
) -> tuple[Float[Array, "run n"], Float[Array, "run n n"], Float[Array, "run n n"]]:
    """Rates of δ, Φ and Q̄ at x ⊞ δ: Φ̇ = F Φ, dQ̄/dt = F Q̄ + Q̄ Fᵀ + Q_s (Bishop, eq. 6, 9).

    F is the Jacobian of the flow minus [ω]× for every rotation, since the body-frame tangent
    rotates.
    """
    space = model.space
    point = space.plus(x, delta)
    rate, F = model.flow_jacobian(point, u, t)
    if not space.flat:
        F = F.copy()
        for first in space.quaternions[:, 1]:
            block = slice(first, first + 3)
            F[..., block, block] -= rotation.skew(rate[..., block])
    half = F @ Q
    driven = half + half.mT + model.spectral_density(point, u, t)
    return chart_rate(space, delta, rate), F @ Phi, driven


def chart_rate(
    space: Manifold, delta: Float[Array, "*lead n"], rate: Float[Array, "*lead n"]
) -> Float[Array, "*lead n"]:
    """δ̇ = J(δ)⁻¹ ẋ: the rate of x ⊞ δ in the chart at x (Hairer et al. 2006, IV.8)."""
    if space.flat:
        return rate
    solved = np.linalg.solve(space.reset_jacobian(delta), rate[..., None])
    return np.asarray(solved[..., 0], np.float64)


def _grid(t: float, dt: float, substeps: int) -> list[tuple[float, float]]:
    """Start and length of each substep."""
    return [(t + k * dt / substeps, dt / substeps) for k in range(substeps)]


def _rk4(
    slope: Callable[[float, tuple[Array, ...]], tuple[Array, ...]],
    t: float,
    h: float,
    state: tuple[Array, ...],
) -> tuple[Array, ...]:
    """One step of the classical Runge-Kutta method on a tuple of arrays."""

    def moved(k: tuple[Array, ...], step: float) -> tuple[Array, ...]:
        return tuple(a + step * b for a, b in zip(state, k, strict=True))

    k1 = slope(t, state)
    k2 = slope(t + h / 2, moved(k1, h / 2))
    k3 = slope(t + h / 2, moved(k2, h / 2))
    k4 = slope(t + h, moved(k3, h))
    mean = tuple((a + 2 * b + 2 * c + d) / 6 for a, b, c, d in zip(k1, k2, k3, k4, strict=True))
    return moved(mean, h)


@dataclass(frozen=True, eq=False)
class ContinuousFunctionModel:
    """ẋ = f(x, u, t) + G(t) u + w, y = h(x, u, t) + v in R^n (Bishop, eq. 1-2).

    RK4 of x, Φ and Q̄ makes it a discrete model too, so every estimator accepts it.

    Attributes:
        f: takes x `(..., n)`, u `(..., nu)` and t in s, returns ẋ `(..., n)` without G u.
        h: measurement; takes x, u and t, returns `(..., m)`.
        Q_s: spectral density of w `(n, n)`, or a function of t.
        R: measurement noise covariance `(m, m)`, or a function of t.
        G: `(n, nu)`, or a function of t; None where f uses u itself, or for no control.
        n_controls: number of controls; with G, the number of its columns.
        f_jacobian, h_jacobian: ∂f/∂x `(..., n, n)` and ∂h/∂x `(..., m, n)`; differences if None.
        batched: whether f, h and their Jacobians take leading axes; if not they are called once
            per state.
        substeps: RK4 steps in one transition.
        differences: scheme and step of the difference Jacobians.
        names, units: names and units of the state coordinates.
        angles, state_angles: components of y, and of x, that are angles; see `FunctionModel`.

    Raises:
        CovarianceError: R is not symmetric positive definite, or Q_s not semidefinite; for a
            function of t, at t = 0 or in a later call.
        DimensionError: G does not fit Q_s. In a later call: a function returns another shape,
            values that are not real numbers, or float32.
        ModelError: in a later call: a function raises.
    """

    f: Function
    h: Function
    Q_s: Matrix
    R: Matrix
    G: Matrix | None = None
    n_controls: int = 0
    f_jacobian: Function | None = None
    h_jacobian: Function | None = None
    batched: bool = True
    substeps: int = 1
    differences: Differences = Differences("centered", 1e-5)  # noqa: RUF009 it is frozen
    names: tuple[str, ...] | None = None
    units: tuple[str, ...] | None = None
    angles: Sequence[int] = ()
    state_angles: Sequence[int] = ()
    _parts: FunctionModel = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not isinstance(self.substeps, int) or self.substeps < 1:
            raise DimensionError(f"substeps is {self.substeps}; use a whole number of at least 1")
        density = matrix_at("Q_s", self.Q_s, 0.0)
        if density.ndim != 2 or density.shape[0] != density.shape[1]:
            raise DimensionError(
                f"Q_s has shape {density.shape}; expected a square matrix, 0.1 * np.eye(1) for one "
                "number"
            )
        check_covariance("Q_s", density, when=" at t = 0" if callable(self.Q_s) else "")
        if self.G is not None:
            G = matrix_at("G", self.G, 0.0)
            if G.shape[:-1] != density.shape[:-1] or self.n_controls not in (0, G.shape[-1]):
                raise DimensionError(
                    f"G has shape {G.shape}; expected ({len(density)}, n_controls) with n_controls "
                    f"{self.n_controls or 'left out'}"
                )
            object.__setattr__(self, "n_controls", G.shape[-1])
        f, slope = self.f, self.f_jacobian
        parts = FunctionModel(
            lambda x, u, t, dt: f(x, u, t), self.h, density, self.R, self.n_controls,
            None if slope is None else lambda x, u, t, dt: slope(x, u, t), self.h_jacobian,
            self.batched, self.differences, self.names, self.units,
            angles=self.angles, state_angles=self.state_angles,
        )  # fmt: skip
        object.__setattr__(self, "_parts", parts)

    @property
    def space(self) -> Manifold:
        """R^n."""
        return self._parts.space

    @property
    def nu(self) -> int:
        """Number of controls."""
        return self.n_controls

    def output(self, channels: Channels = None) -> Manifold:
        """R^m; the model has a single channel."""
        return self._parts.output()

    def flow(
        self, x: Float[Array, "*lead nx"], u: Float[Array, "... nu"], t: float = 0.0
    ) -> Float[Array, "*lead n"]:
        """ẋ = f + G u."""
        return self._driven(self._parts.transition(x, u, t, 0.0), u, t)

    def flow_jacobian(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float = 0.0
    ) -> tuple[Float[Array, "run n"], Float[Array, "run n n"]]:
        """ẋ = f + G u and ∂f/∂x."""
        rate, F = self._parts.transition_jacobian(x, u, t, 0.0)
        return self._driven(rate, u, t), F

    def spectral_density(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float = 0.0
    ) -> Float[Array, "... n n"]:
        """Q_s."""
        density = matrix_at("Q_s", self.Q_s, t)
        if callable(self.Q_s):
            n = self.space.n
            if density.shape != (n, n):
                raise DimensionError(f"Q_s returned shape {density.shape}; expected {(n, n)}")
            check_covariance("Q_s", density, when=f" at t = {t:g}")
        return density

    def transition(
        self, x: Float[Array, "*lead nx"], u: Float[Array, "... nu"], t: float, dt: float
    ) -> Float[Array, "*lead nx"]:
        """The state after dt by RK4."""
        return integrate(self, x, u, t, dt, self.substeps)

    def transition_jacobian(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float, dt: float
    ) -> tuple[Float[Array, "run nx"], Float[Array, "run n n"]]:
        """The state and Φ after dt by RK4 (Bishop, eq. 10)."""
        return integrate_moments(self, x, u, t, dt, self.substeps)[:2]

    def process_noise(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float, dt: float
    ) -> Float[Array, "... n n"]:
        """Q̄ after dt by RK4 (Bishop, eq. 10)."""
        return integrate_moments(self, x, u, t, dt, self.substeps)[2]

    def measurement(
        self,
        x: Float[Array, "*lead nx"],
        u: Float[Array, "... nu"],
        t: float = 0.0,
        channels: Channels = None,
    ) -> Float[Array, "*lead ny"]:
        """h(x, u, t)."""
        return self._parts.measurement(x, u, t)

    def measurement_jacobian(
        self,
        x: Float[Array, "run nx"],
        u: Float[Array, "run nu"],
        t: float = 0.0,
        channels: Channels = None,
    ) -> tuple[Float[Array, "run ny"], Float[Array, "run m n"]]:
        """The measurement and ∂h/∂x."""
        return self._parts.measurement_jacobian(x, u, t)

    def measurement_noise(
        self, t: float = 0.0, channels: Channels = None
    ) -> Float[Array, "... m m"]:
        """R."""
        return self._parts.measurement_noise(t)

    def _driven(self, rate: Array, u: Array, t: float) -> Array:
        if self.G is None:
            return rate
        push = u @ matrix_at("G", self.G, t).T
        return rate + (push if rate.ndim == push.ndim else push[:, None])
