"""A model whose state is augmented with biases or unknown inputs.

The remedy for biases of source 002: x_a = (x, b, d), x⁺ = f(x, u + E d) ⊞ w,
y = h(x, u + E d) ⊞ (C b) ⊞ v, where b and d are constants, random walks or first-order Gauss-Markov
processes (Gelb 1974, ch. 3).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from estbench.errors import ScenarioError, did_you_mean
from estbench.models.differences import Differences
from estbench.models.protocol import Channels, Model
from estbench.shapes import Array, Float
from estbench.spaces.linalg import added_first
from estbench.spaces.manifold import Manifold, carry
from estbench.spaces.patterns import expand

PerName = float | Sequence[float] | dict[str, float]


@dataclass(frozen=True)
class Bias:
    """One unknown that is added to a measurement coordinate or to a control.

    By default it is constant. With `walk` it is a random walk, with `time_constant` a stationary
    Gauss-Markov process.

    Attributes:
        target: name of the measurement coordinate, or `u0`, `u1`, ... for a control.
        std: standard deviation at the start, in the unit of the target.
        walk: intensity of the random walk, unit of the target per √s.
        time_constant: correlation time of the Gauss-Markov process, s; 0 for none.
    """

    target: str
    std: float
    walk: float = 0.0
    time_constant: float = 0.0

    def __post_init__(self) -> None:
        for name in ("std", "walk", "time_constant"):
            value = getattr(self, name)
            if not 0 <= value < np.inf:
                raise ScenarioError(
                    f"bias of {self.target}: {name} is {value!r}; use a number of at least 0"
                )
        if self.walk and self.time_constant:
            raise ScenarioError(
                f"bias of {self.target} has both walk and time_constant; give one of them"
            )


@dataclass(frozen=True, eq=False)
class Augmented:
    """The model with biases of measurement coordinates and unknown inputs as further states.

    The new states are called `bias.TARGET` and `input.TARGET`. A bias of a rotation (quaternion
    channel) is a body-frame rotation vector. Each input costs a Jacobian 2 more transitions or
    measurements. With inputs the points of one run are passed to the model as separate runs, so the
    parameters of the model must not differ between runs.

    Attributes:
        model: the model to augment.
        sensors: biases of measurement coordinates, named as in `model.output().names`.
        inputs: unknowns added to the controls `u0`, `u1`, ...
        differences: scheme and step of the Jacobians with respect to the inputs.

    Raises:
        ScenarioError: a target does not exist or is named twice.
    """

    model: Model
    sensors: Sequence[Bias] = ()
    inputs: Sequence[Bias] = ()
    differences: Differences = field(default_factory=lambda: Differences("centered", 1e-5))
    space: Manifold = field(init=False, repr=False)
    _names: tuple[str, ...] = field(init=False, repr=False)
    _E: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        base, output = self.model.space, self.model.output()
        controls = tuple(f"u{i}" for i in range(self.model.nu))
        sensors, inputs = (tuple(b.target for b in group) for group in (self.sensors, self.inputs))
        units = dict(zip(output.names, output.units))
        for targets, known in ((sensors, output.names), (inputs, controls)):
            for target in targets:
                if target not in known:
                    raise ScenarioError(
                        f"bias of {target}: no such name{did_you_mean(target, known)}"
                    )
                if targets.count(target) > 1:
                    raise ScenarioError(f"bias of {target} is given twice; give it once")
        space = Manifold(
            (*base.names, *(f"bias.{s}" for s in sensors), *(f"input.{i}" for i in inputs)),
            (*base.units, *(units[s] for s in sensors), *("1" for _ in inputs)),
            base.quaternions,
            base.angles,
        )
        object.__setattr__(self, "space", space)
        object.__setattr__(self, "_names", sensors)
        object.__setattr__(self, "_E", _selection(controls, inputs))

    @classmethod
    def build(
        cls,
        model: Model,
        bias: PerName = 0.0,
        walk: PerName = 0.0,
        time_constant: PerName = 0.0,
        inputs: PerName = 0.0,
        input_walk: PerName = 0.0,
        input_time_constant: PerName = 0.0,
    ) -> "Augmented":
        """Augment by patterns: a coordinate with a nonzero std in `bias` or `inputs` gets a bias.

        Args:
            model: the model to augment.
            bias: std of the bias of each measurement coordinate: a number, a list or
                {pattern: number}.
            walk: intensity of the random walk of each bias.
            time_constant: correlation time of each bias, s.
            inputs: std of the unknown added to each control.
            input_walk: intensity of the random walk of each input.
            input_time_constant: correlation time of each input, s.

        Raises:
            ScenarioError: a pattern matches no name, or a value is negative.
        """
        names, controls = model.output().names, tuple(f"u{i}" for i in range(model.nu))
        settings = (bias, "bias"), (walk, "walk"), (time_constant, "time_constant")
        sensors = zip(names, *(expand(value, names, what).tolist() for value, what in settings))
        settings = (
            (inputs, "inputs"), (input_walk, "input_walk"),
            (input_time_constant, "input_time_constant"),
        )  # fmt: skip
        unknown = zip(
            controls, *(expand(value, controls, what).tolist() for value, what in settings)
        )
        return cls(
            model,
            tuple(Bias(name, s, w, c) for name, s, w, c in sensors if s != 0),
            tuple(Bias(name, s, w, c) for name, s, w, c in unknown if s != 0),
        )

    @property
    def nu(self) -> int:
        """Number of controls."""
        return self.model.nu

    @property
    def biases(self) -> tuple[Bias, ...]:
        """The added states, in order."""
        return (*self.sensors, *self.inputs)

    def augment(
        self, mean: Float[Array, "run nx"], cov: Float[Array, "run n n"]
    ) -> tuple[Float[Array, "run nx_augmented"], Float[Array, "run n_augmented n_augmented"]]:
        """x̂₀ and P₀ with the biases appended: zero mean, variance `std`²."""
        extra = len(self.biases)
        variance = np.array([b.std**2 for b in self.biases])
        mean = np.concatenate([mean, np.zeros((len(mean), extra))], axis=-1)
        return mean, _padded(cov, variance)

    def output(self, channels: Channels = None) -> Manifold:
        """The measurement's manifold."""
        return self.model.output(channels)

    def transition(
        self, x: Float[Array, "*lead nx"], u: Float[Array, "... nu"], t: float, dt: float
    ) -> Float[Array, "*lead nx"]:
        """f(x, u + E d) for the state; each bias is multiplied by exp(-dt/τ), or by 1 without τ."""
        x, b, d = self._split(x)
        moved = self._rows(lambda p, v: self.model.transition(p, v, t, dt), x, u, d)
        return np.concatenate([moved, np.concatenate([b, d], axis=-1) * self._decay(dt)], axis=-1)

    def transition_jacobian(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float, dt: float
    ) -> tuple[Float[Array, "run nx"], Float[Array, "run n n"]]:
        """The transition and Φ = [Φ 0 ∂f/∂d; 0 φ]."""
        x, b, d = self._split(x)
        moved, inner = self.model.transition_jacobian(x, added_first(u, d @ self._E.T), t, dt)
        n, decay = self.model.space.n, self._decay(dt)
        F = np.zeros((len(x), self.space.n, self.space.n))
        F[:, :n, :n] = inner
        F[:, n:, n:] = np.diag(decay)
        F[:, :n, n + len(self.sensors) :] = self._input_slope(
            lambda p, v: self.model.transition(p, v, t, dt), self.model.space, x, u, d
        )
        return np.concatenate([moved, np.concatenate([b, d], axis=-1) * decay], axis=-1), F

    def process_noise(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float, dt: float
    ) -> Float[Array, "... n n"]:
        """Q and, for the biases, walk² dt or std² (1 - φ²)."""
        x, _, d = self._split(x)
        Q = self.model.process_noise(x, added_first(u, d @ self._E.T), t, dt)
        walk, std = (np.array([getattr(b, k) for b in self.biases]) for k in ("walk", "std"))
        return _padded(Q, walk**2 * dt + std**2 * (1.0 - self._decay(dt) ** 2))

    def measurement(
        self,
        x: Float[Array, "*lead nx"],
        u: Float[Array, "... nu"],
        t: float,
        channels: Channels = None,
    ) -> Float[Array, "*lead ny"]:
        """h(x, u + E d) ⊞ C b."""
        x, b, d = self._split(x)
        y = self._rows(lambda p, v: self.model.measurement(p, v, t, channels), x, u, d)
        output = self.model.output(channels)
        return output.plus(y, b @ _selection(output.names, self._names).T)

    def measurement_jacobian(
        self,
        x: Float[Array, "run nx"],
        u: Float[Array, "run nu"],
        t: float,
        channels: Channels = None,
    ) -> tuple[Float[Array, "run ny"], Float[Array, "run m n"]]:
        """The measurement and [H, C, ∂h/∂d], in the tangent at the biased measurement."""
        x, b, d = self._split(x)
        output = self.model.output(channels)
        C = _selection(output.names, self._names)
        shift = b @ C.T
        y, H = self.model.measurement_jacobian(x, added_first(u, d @ self._E.T), t, channels)
        G = self._input_slope(
            lambda p, v: self.model.measurement(p, v, t, channels), output, x, u, d
        )
        H, C = carry(output, shift, np.concatenate([H, G], axis=-1), C)
        n = self.model.space.n
        return output.plus(y, shift), np.concatenate([H[..., :n], C, H[..., n:]], axis=-1)

    def measurement_noise(self, t: float, channels: Channels = None) -> Float[Array, "... m m"]:
        """R."""
        return self.model.measurement_noise(t, channels)

    def _split(self, x: Array) -> tuple[Array, Array, Array]:
        """The parts of an augmented state `(..., nx)`: state, biases, inputs."""
        parts = np.split(x, [self.model.space.nx, self.model.space.nx + len(self.sensors)], axis=-1)
        return parts[0], parts[1], parts[2]

    def _decay(self, dt: float) -> Array:
        return np.array(
            [np.exp(-dt / b.time_constant) if b.time_constant else 1.0 for b in self.biases]
        )

    def _rows(self, function, x: Array, u: Array, d: Array) -> Array:
        """A function of state and control, evaluated at u + E d; d may differ between points."""
        if not self.inputs:
            return function(x, u)
        if x.ndim == 2:
            return function(x, added_first(u, d @ self._E.T))
        v = added_first(u[:, None], d @ self._E.T)
        return function(x.reshape(-1, x.shape[-1]), v.reshape(-1, v.shape[-1])).reshape(
            *x.shape[:2], -1
        )

    def _input_slope(self, function, target: Manifold, x: Array, u: Array, d: Array) -> Array:
        """∂/∂d `(run, m, inputs)` of a function of state and control, by differences."""
        if not self.inputs:
            return np.zeros((len(x), target.n, 0))

        def at(points: Array) -> Array:
            states = np.broadcast_to(x[:, None], (*points.shape[:2], x.shape[-1]))
            return self._rows(function, states, u, points)

        return self.differences.jacobian(at, Manifold.euclidean(len(self.inputs)), target, d)[1]


def _selection(names: Sequence[str], chosen: Sequence[str]) -> Array:
    """Matrix `(len(names), len(chosen))` with a one where the names agree."""
    rows = [[float(a == b) for b in chosen] for a in names]
    return np.array(rows).reshape(len(names), len(chosen))


def _padded(cov: Array, variance: Array) -> Array:
    """Block-diagonal covariance `(..., n + k, n + k)` of cov `(..., n, n)` and k variances."""
    n, k = cov.shape[-1], len(variance)
    out = np.zeros((*cov.shape[:-2], n + k, n + k))
    out[..., :n, :n] = cov
    out[..., n:, n:] = np.diag(variance)
    return out
