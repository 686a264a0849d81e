"""A model from functions f and h of the user, written for one state or for a batch."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from estbench.errors import DimensionError, ModelError, shown
from estbench.models.calls import Matrix, call, matrix_at, numbers
from estbench.models.differences import Differences
from estbench.models.protocol import Channels
from estbench.shapes import Array, Float
from estbench.spaces.covariance import check_covariance
from estbench.spaces.manifold import Manifold

Function = Callable[..., Array]


@dataclass(frozen=True, eq=False)
class FunctionModel:
    """x⁺ = f(x, u, t, dt) + Ω w, y = h(x, u, t) + v (source 001, eq. 1-2; source 002).

    Attributes:
        f: transition; takes x `(..., n)`, u `(..., nu)`, t and dt in s, returns `(..., n)`. It
            returns NaN for a state that it cannot compute; only the run of that state then fails.
        h: measurement; takes x `(..., n)`, u `(..., nu)` and t, returns `(..., m)`.
        Q: covariance of w in one step `(n, n)`, or `(k, k)` with Ω; or a function of t and dt.
        R: measurement noise covariance `(m, m)`, or a function of t.
        n_controls: number of controls.
        f_jacobian, h_jacobian: ∂f/∂x `(..., n, n)` and ∂h/∂x `(..., m, n)`; differences if None.
        batched: whether f, h and their Jacobians take leading axes; if not they are called once
            per state, and may return a number where the result has one component.
        differences: scheme and step of the difference Jacobians.
        names, units: names and units of the state coordinates.
        noise_gain: Ω `(n, k)`, or a function of x, u, t and dt that returns ∂x⁺/∂w `(..., n, k)`;
            the process noise is then Ω Q Ωᵀ at the estimate. Default: the identity.
        n_states: n; needed where Ω is a function, else taken from Q or Ω.
        angles: components of y that are angles, rad; their differences are taken into [-π, π].
        state_angles: components of x that are angles, rad; likewise.

    Raises:
        CovarianceError: R is not symmetric positive definite, or Q not semidefinite; for a function
            of t, at t = 0 or in a later call.
        DimensionError: Q, R or Ω does not fit the others. In a later call: a function returns
            another shape, values that are not real numbers, or float32.
        ModelError: f or h is not a function. In a later call: a function raises.
    """

    f: Function
    h: Function
    Q: Matrix
    R: Matrix
    n_controls: int = 0
    f_jacobian: Function | None = None
    h_jacobian: Function | None = None
    batched: bool = True
    differences: Differences = Differences("centered", 1e-5)  # noqa: RUF009 it is frozen
    names: tuple[str, ...] | None = None
    units: tuple[str, ...] | None = None
    noise_gain: Function | Array | None = None
    n_states: int = 0
    angles: Sequence[int] = ()
    state_angles: Sequence[int] = ()
    space: Manifold = field(init=False, repr=False)
    _output: Manifold = field(init=False, repr=False)
    _noises: int = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("f", "h", "f_jacobian", "h_jacobian"):
            given = getattr(self, name)
            if not callable(given) and (given is not None or name in ("f", "h")):
                raise ModelError(f"{name} is of type {type(given).__name__}; give a function")
        for name in ("n_controls", "n_states"):
            count = getattr(self, name)
            if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 0:
                raise DimensionError(f"{name} is {shown(count)}; use a whole number of at least 0")
        Q = _covariance("Q", self.Q, "semidefinite", 0.0, 1.0)
        R = _covariance("R", self.R, "definite", 0.0)
        gain = self.noise_gain
        if gain is not None and not callable(gain):
            gain = matrix_at("noise_gain", gain)
        for name, constant in (("Q", Q), ("R", R), ("noise_gain", gain)):
            if not callable(getattr(self, name)):
                object.__setattr__(self, name, constant)
        if callable(gain) and self.n_states < 1:
            raise DimensionError(
                f"n_states is {self.n_states}; give the count of states where noise_gain is a "
                "function"
            )
        if gain is not None and not callable(gain) and (gain.ndim != 2 or gain.shape[-1] != len(Q)):
            raise DimensionError(
                f"noise_gain has shape {gain.shape}; expected (n, {len(Q)}) to fit Q"
            )
        n = self.n_states or (Q if gain is None or callable(gain) else gain).shape[-2]
        if not callable(gain) and n != (Q if gain is None else gain).shape[-2]:
            name, matrix, k = ("Q", Q, n) if gain is None else ("noise_gain", gain, len(Q))
            raise DimensionError(
                f"{name} has shape {matrix.shape}; expected {(n, k)} for {n} states"
            )
        names = [f"y{i}" for i in range(len(R))]
        space = Manifold.euclidean(n, self.names, self.units, self.state_angles)
        output = Manifold.euclidean(len(R), names, angles=self.angles)
        object.__setattr__(self, "space", space)
        object.__setattr__(self, "_output", output)
        object.__setattr__(self, "_noises", len(Q))

    @property
    def nu(self) -> int:
        """Number of controls."""
        return self.n_controls

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
        """f(x, u, t, dt)."""
        return self._call("f", self.f, (self.space.n,), x, u, t, dt)

    def transition_jacobian(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float = 0.0, dt: float = 1.0
    ) -> tuple[Float[Array, "run nx"], Float[Array, "run n n"]]:
        """F and ∂f/∂x."""
        n = self.space.n
        if self.f_jacobian is None:
            return self.differences.jacobian(
                lambda p: self.transition(p, u, t, dt), self.space, self.space, x
            )
        F = self._call("f_jacobian", self.f_jacobian, (n, n), x, u, t, dt)
        return self.transition(x, u, t, dt), F

    def process_noise(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float = 0.0, dt: float = 1.0
    ) -> Float[Array, "... n n"]:
        """Q, or Ω Q Ωᵀ."""
        gain, Q = self.noise_gain, self.Q
        if callable(Q):
            Q = _covariance("Q", Q, "semidefinite", t, dt)
        if Q.shape != (self._noises, self._noises):
            raise DimensionError(
                f"Q returned shape {Q.shape}; expected {(self._noises, self._noises)}"
            )
        if gain is None:
            return Q
        if callable(gain):
            gain = self._call("noise_gain", gain, (self.space.n, len(Q)), x, u, t, dt)
        return gain @ Q @ gain.mT

    def measurement(
        self,
        x: Float[Array, "*lead nx"],
        u: Float[Array, "... nu"],
        t: float = 0.0,
        channels: Channels = None,
    ) -> Float[Array, "*lead ny"]:
        """h(x, u, t)."""
        return self._call("h", self.h, (self._output.n,), x, u, t)

    def measurement_jacobian(
        self,
        x: Float[Array, "run nx"],
        u: Float[Array, "run nu"],
        t: float = 0.0,
        channels: Channels = None,
    ) -> tuple[Float[Array, "run ny"], Float[Array, "run m n"]]:
        """H and ∂h/∂x."""
        n, m = self.space.n, self._output.n
        if self.h_jacobian is None:
            return self.differences.jacobian(
                lambda p: self.measurement(p, u, t), self.space, self._output, x
            )
        H = self._call("h_jacobian", self.h_jacobian, (m, n), x, u, t)
        return self.measurement(x, u, t), H

    def measurement_noise(
        self, t: float = 0.0, channels: Channels = None
    ) -> Float[Array, "... m m"]:
        """R."""
        R, m = self.R, self._output.n
        if callable(R):
            R = _covariance("R", R, "definite", t)
        if R.shape != (m, m):
            raise DimensionError(f"R returned shape {R.shape}; expected {(m, m)}")
        return R

    def _call(
        self,
        name: str,
        function: Function,
        shape: tuple[int, ...],
        x: Array,
        u: Array,
        *time: float,
    ) -> Array:
        """Call a user's function on states `(run, n)` or `(run, point, n)` and check the result."""
        if x.ndim == 3:
            u = np.broadcast_to(u[:, None], (*x.shape[:2], u.shape[-1]))
        full = (*x.shape[:-1], *shape)
        if not self.batched:
            states = x.reshape(-1, x.shape[-1])
            rows = zip(states, u.reshape(len(states), u.shape[-1]), strict=True)
            return np.reshape([_one(name, function, shape, *row, *time) for row in rows], full)
        points = " = (run, point, n): several points of each run at once, so index x[..., i]"
        expected = (
            f"{full} for x of shape {x.shape}{points if x.ndim == 3 else ''} (a function written "
            "for one state needs batched=False)"
        )
        given = call(name, function, x, u, *time)
        out = numbers(f"{name} returned", given, f"shape {expected}")
        if out.shape == shape:  # a constant Jacobian
            out = np.broadcast_to(out, full)
        elif isinstance(given, list | tuple):
            raise DimensionError(
                f"{name} returned {type(given).__name__} of {len(given)}; np.stack(parts, axis=-1) "
                f"makes an array of it; expected shape {expected}"
            )
        if out.shape != full:
            raise DimensionError(f"{name} returned shape {out.shape}; expected {expected}")
        return out


def _one(name: str, function: Function, shape: tuple[int, ...], *args: Array | float) -> Array:
    """The result of a function written for one state, in the expected shape."""
    out = call(name, function, *args)
    out = numbers(f"{name} returned", out, f"shape {shape} for one state")
    if out.shape != shape and (out.ndim or np.prod(shape) != 1):
        raise DimensionError(f"{name} returned shape {out.shape}; expected {shape} for one state")
    return out.reshape(shape)


def _covariance(name: str, matrix: Matrix, positive: str, *time: float) -> Array:
    """Q or R at a time, checked to be positive `definite` or `semidefinite`."""
    value = matrix_at(name, matrix, *time)
    if value.ndim != 2 or value.shape[0] != value.shape[1]:
        raise DimensionError(
            f"{name} has shape {value.shape}; expected a square matrix, 0.1 * np.eye(1) for one "
            "number"
        )
    when = f" at t = {time[0]:g}" if callable(matrix) else ""
    check_covariance(name, value, positive == "definite", when)
    return value
