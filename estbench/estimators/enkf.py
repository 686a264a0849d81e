"""Ensemble Kalman filter, stochastic or deterministic (Evensen 2003; Tippett et al. 2003)."""

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from estbench.estimators.beliefs import Fault, check_prior, random_start
from estbench.estimators.no_return import extended
from estbench.estimators.protocol import Innovation
from estbench.estimators.settings import has_model, in_range, one_of, whole
from estbench.estimators.update import Correction, correct
from estbench.models.protocol import Channels, Model
from estbench.randomness import counter as random
from estbench.shapes import Array, Bool, Faults, Float, Keys, Mask, UInt
from estbench.spaces.linalg import cholesky, pad_absent, solve_lower_transposed, symmetrize
from estbench.spaces.manifold import Manifold

INITIAL, PROCESS, MEASUREMENT = range(3)
"""Purposes of the random numbers."""


@dataclass(frozen=True, eq=False)
class Ensemble:
    """A belief as equally likely points; a failed run has NaN and its `Fault`.

    Attributes:
        points: the ensemble of each run.
        keys: keys of the random numbers of each run.
        counter: number of predictions and of measurements that arrived.
        fault: `Fault` of each run.
    """

    points: Float[Array, "run size nx"]
    keys: random.Keys
    counter: random.Keys
    fault: UInt[Faults, " run"]


@dataclass(frozen=True)
class EnKF:
    """Ensemble Kalman filter: the model propagates points; there is no Jacobian and no stored P.

    Cost per step: `size` transitions and `size` measurements. Choose it where n is too large for
    2 n + 1 sigma points, or the belief is not Gaussian but has one peak. The error of P is of order
    sqrt(2/size); below a few times n points P is too small, and `inflation` is the usual remedy.

    Attributes:
        model: the filter's model. Q is taken at the ensemble's mean.
        form: `stochastic` (perturbed observations, Burgers, van Leeuwen & Evensen 1998; the
            perturbations are centred) or `deterministic` (square root with the reduced gain of
            Whitaker & Hamill 2002, eq. 10: R is not sampled).
        size: number of points, at least 2.
        inflation: factor on the deviations after a prediction (Anderson & Anderson 1999).
    """

    model: Model
    form: Literal["stochastic", "deterministic"] = "stochastic"
    size: int = 100
    inflation: float = 1.0

    def __post_init__(self) -> None:
        has_model(self)
        one_of(self, "form", ("stochastic", "deterministic"))
        whole(self, "size", 2)
        in_range(self, "inflation", 1.0)

    def init(
        self,
        mean: Float[Array, "run nx"],
        cov: Float[Array, "run n n"],
        keys: UInt[Keys, " run"] | None = None,
    ) -> Ensemble:
        """Points drawn from N(mean, cov); `keys`, one per run, default to 0, 1, ..."""
        return _marked(Ensemble(*draw(self.model.space, mean, cov, self.size, keys)))

    def predict(self, belief: Ensemble, u: Float[Array, "run nu"], t: float, dt: float) -> Ensemble:
        """xᵢ⁻ = f(xᵢ⁺, u) ⊞ wᵢ, wᵢ ~ N(0, Q), then deviations times `inflation`."""
        space, mean = self.model.space, self.mean(belief)
        points = diffuse(self.model, belief, mean, u, t, dt)
        if self.inflation != 1.0:
            mean = self._centre(space, points)
            points = space.plus(mean[:, None], self.inflation * space.minus(points, mean[:, None]))
        return _marked(replace(belief, points=points, counter=belief.counter + np.uint64(1)))

    def update(
        self,
        belief: Ensemble,
        y: Float[Array, "run ny"],
        u: Float[Array, "run nu"],
        t: float,
        channels: Channels = None,
        mask: Bool[Mask, "run m"] | None = None,
    ) -> tuple[Ensemble, Innovation]:
        """Correct every point with K = Pxy S⁻¹, in the tangent at the mean of the ensemble."""
        space, output = self.model.space, self.model.output(channels)
        R = np.asarray(self.model.measurement_noise(t, channels))
        images = self.model.measurement(belief.points, u, t, channels)
        images, mask = extended(space, output, belief.points, images, mask)
        predicted = self._centre(output, images)
        spread = output.minus(images, predicted[:, None])
        mean = self.mean(belief)
        deviation = space.minus(belief.points, mean[:, None])
        S = symmetrize(self._cross(spread, spread) + R)
        c = correct(output.minus(y, predicted), S, self._cross(deviation, spread), mask)
        present = np.ones(y.shape[:1] + S.shape[-1:], bool) if mask is None else mask
        if self.form == "stochastic":
            noise = random.gaussian(belief.keys, belief.counter, MEASUREMENT, R, self.size)
            noise = noise - noise.mean(axis=1, keepdims=True)
            noise *= np.sqrt(self.size / (self.size - 1))
            surprise = np.where(present[:, None], output.minus(y[:, None], images) + noise, 0.0)
            move = surprise @ c.gain.mT
        else:
            spread = np.where(present[:, None], spread, 0.0)
            move = c.delta[:, None] - spread @ _reduced_gain(c, R, present)
        arrived = np.any(present, axis=-1, keepdims=True)
        moved = space.plus(mean[:, None], deviation + move)
        posterior = replace(
            belief,
            points=np.where(arrived[..., None], moved, belief.points),
            counter=belief.counter + arrived[:, 0].astype(np.uint64),
        )
        return _marked(posterior, c.fault), c.innovation

    def mean(self, belief: Ensemble) -> Float[Array, "run nx"]:
        """The mean x̂ of the ensemble on the manifold."""
        mean = self._centre(self.model.space, belief.points)
        return np.where(belief.fault[:, None] > 0, np.nan, mean)

    def cov(self, belief: Ensemble) -> Float[Array, "run n n"]:
        """The covariance P of the ensemble (divisor size - 1) in the tangent at x̂."""
        deviation = self.model.space.minus(belief.points, self.mean(belief)[:, None])
        return symmetrize(self._cross(deviation, deviation))

    def _centre(self, space: Manifold, points: Array) -> Array:
        return space.mean(points, np.full(self.size, 1.0 / self.size))

    def _cross(self, a: Array, b: Array) -> Array:
        """Sample covariance `(run, n, m)` of deviations `(run, size, n)` and `(run, size, m)`."""
        return a.mT @ b / (self.size - 1)


def draw(
    space: Manifold,
    mean: Float[Array, "run nx"],
    cov: Float[Array, "run n n"],
    size: int,
    keys: random.Keys | None,
) -> tuple[Float[Array, "run size nx"], random.Keys, random.Keys, UInt[Faults, " run"]]:
    """Points x̂ ⊞ N(0, P), keys, counters, and faults where P has no square root."""
    check_prior(space, mean, cov)
    keys, counter = random_start(len(mean), keys)
    error = random.gaussian(keys, counter, INITIAL, cov, size)
    failed = ~np.isfinite(error).all(axis=(-2, -1))
    fault = np.where(failed, Fault.COVARIANCE, Fault.NONE).astype(np.uint8)
    return space.plus(mean[:, None], error), keys, counter, fault


def diffuse(
    model: Model,
    belief: Any,
    mean: Float[Array, "run nx"],
    u: Float[Array, "run nu"],
    t: float,
    dt: float,
) -> Float[Array, "run size nx"]:
    """The transition of each point with process noise drawn from N(0, Q), Q at the mean."""
    points = model.transition(belief.points, u, t, dt)
    Q = np.asarray(model.process_noise(mean, u, t, dt))
    noise = random.gaussian(belief.keys, belief.counter, PROCESS, Q, points.shape[1])
    return model.space.plus(points, noise)


def _reduced_gain(c: Correction, R: Array, present: NDArray[np.bool_]) -> Array:
    """K̃ᵀ `(run, m, n)`, K̃ = Pxy A⁻ᵀ (A + B)⁻¹ with A Aᵀ = S, B Bᵀ = R both lower triangular.

    Whitaker & Hamill 2002, eq. 10, after Andrews 1968: it holds for any square roots, so Cholesky
    factors do. c.gain is Pxy S⁻¹, hence Pxy A⁻ᵀ = K A.
    """
    A = cholesky(c.innovation.cov)
    B = cholesky(pad_absent(R, present))
    return solve_lower_transposed(A + B, np.swapaxes(c.gain @ A, -1, -2))


def _marked(belief: Ensemble, fault: Any = 0) -> Ensemble:
    """The belief with every run that is not finite, or has a new `fault`, set to NaN and marked."""
    finite = np.isfinite(belief.points).all(axis=(-2, -1))
    new = np.where(fault, fault, np.where(finite, Fault.NONE, Fault.STATE))
    code = np.where(belief.fault, belief.fault, new).astype(np.uint8)
    if not code.any():
        return belief
    return replace(
        belief, points=np.where(code[:, None, None] > 0, np.nan, belief.points), fault=code
    )
