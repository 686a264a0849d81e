"""Bootstrap particle filter (Gordon, Salmond & Smith 1993; Arulampalam et al. 2002, alg. 4)."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estbench.estimators.beliefs import Fault
from estbench.estimators.enkf import Ensemble, diffuse, draw
from estbench.estimators.likelihood import log_normalization
from estbench.estimators.no_return import extended
from estbench.estimators.protocol import Innovation
from estbench.estimators.settings import has_model, in_range, whole
from estbench.estimators.update import correct
from estbench.models.protocol import Channels, Model
from estbench.randomness import counter as random
from estbench.shapes import Array, Bool, Float, Int, Keys, Mask, UInt
from estbench.spaces.linalg import cholesky, pad_absent, solve_lower, symmetrize
from estbench.spaces.manifold import Manifold

RESAMPLING, KERNEL = 3, 4
"""Further purposes of the random numbers."""


@dataclass(frozen=True, eq=False)
class Particles(Ensemble):
    """Weighted points; `log_weights` are normalized, and -inf for a dead particle."""

    log_weights: Float[Array, "run size"]


@dataclass(frozen=True)
class ParticleFilter:
    """Bootstrap particle filter: the model propagates points, the likelihood weights them.

    Cost per step: `size` transitions and `size` measurements. Choose it where the belief has
    several peaks or hard limits. The number of particles needed grows exponentially with the
    dimension that is measured, so above n = 6 or so prefer a Gaussian filter or the EnKF.

    A particle whose transition is NaN is dead; a run fails when all its particles are dead. It also
    fails (`Fault.WEIGHTS`) when a resampling without regularization leaves no more than n distinct
    particles: P is then singular, because the weights of the others have vanished.

    Attributes:
        model: the filter's model. Q is taken at the mean of the particles.
        size: number of particles, at least 2.
        threshold: resample (systematic, Kitagawa 1996) when the effective sample size
            1/Σ w² is below this share of `size`; 0 never, 1 always.
        regularization: after resampling, spread the particles by a Gaussian kernel of this many
            times the optimal bandwidth (Silverman 1986, sec. 4.3; Musso, Oudjane & Le Gland 2001),
            and shrink them towards their mean, which preserves mean and covariance (Liu & West
            2001). 0 is off; 0.5 to 1 keeps particles distinct when Q is small.
    """

    model: Model
    size: int = 1000
    threshold: float = 0.5
    regularization: float = 0.0

    def __post_init__(self) -> None:
        has_model(self)
        whole(self, "size", 2)
        in_range(self, "threshold", 0.0, 1.0)
        in_range(self, "regularization", 0.0)

    def init(
        self,
        mean: Float[Array, "run nx"],
        cov: Float[Array, "run n n"],
        keys: UInt[Keys, " run"] | None = None,
    ) -> Particles:
        """Particles drawn from N(mean, cov); `keys`, one per run, default to 0, 1, ..."""
        start = draw(self.model.space, mean, cov, self.size, keys)
        return _settled(Particles(*start, np.full((len(mean), self.size), -np.log(self.size))))

    def predict(
        self, belief: Particles, u: Float[Array, "run nu"], t: float, dt: float
    ) -> Particles:
        """xᵢ⁻ = f(xᵢ⁺, u) ⊞ wᵢ, wᵢ ~ N(0, Q)."""
        points = diffuse(self.model, belief, self.mean(belief), u, t, dt)
        return _settled(replace(belief, points=points, counter=belief.counter + np.uint64(1)))

    def update(
        self,
        belief: Particles,
        y: Float[Array, "run ny"],
        u: Float[Array, "run nu"],
        t: float,
        channels: Channels = None,
        mask: Bool[Mask, "run m"] | None = None,
    ) -> tuple[Particles, Innovation]:
        """Adds log N(y ⊖ h(xᵢ); 0, R) to log wᵢ, then resamples where it is due.

        The innovation is that of the particles' prior mean and covariance; its log-likelihood is
        log Σᵢ wᵢ N(y ⊖ h(xᵢ); 0, R) (Särkkä & Svensson 2023, ch. 16).
        """
        output = self.model.output(channels)
        m = output.n
        R = np.broadcast_to(self.model.measurement_noise(t, channels), (len(y), m, m))
        images = self.model.measurement(belief.points, u, t, channels)
        images, mask = extended(self.model.space, output, belief.points, images, mask)
        present = np.ones((len(y), m), bool) if mask is None else mask
        blind = _unfinite(images)
        images = np.where(blind[..., None], _best(belief, images, blind)[:, None], images)
        weights = _weights(belief)
        predicted = output.mean(images, weights)
        spread = output.minus(images, predicted[:, None])
        S = symmetrize((spread * weights[..., None]).mT @ spread + R)
        c = correct(output.minus(y, predicted), S, np.zeros((len(y), 0, m)), mask)
        lower = cholesky(pad_absent(R, present))
        residual = np.where(present[:, None], output.minus(y[:, None], images), 0.0)
        white = solve_lower(lower, residual.mT)
        gained = np.where(blind, -np.inf, -0.5 * (white**2).sum(axis=-2))
        likelihood = _log_mean(belief, gained) - log_normalization(lower, present.sum(axis=-1))
        arrived = np.any(present, axis=-1, keepdims=True)
        counter = belief.counter + arrived[:, 0].astype(np.uint64)
        logs = np.where(arrived, belief.log_weights + gained, belief.log_weights)
        weighted = _settled(replace(belief, log_weights=logs))
        logs = np.where(arrived, weighted.log_weights, belief.log_weights)
        weighted = replace(weighted, log_weights=logs)
        innovation = replace(c.innovation, log_likelihood=likelihood, gain=None)
        return replace(self._resampled(weighted, arrived[:, 0]), counter=counter), innovation

    def mean(self, belief: Particles) -> Float[Array, "run nx"]:
        """The weighted mean x̂ of the particles on the manifold."""
        mean = self.model.space.mean(belief.points, _weights(belief))
        return np.where(belief.fault[:, None] > 0, np.nan, mean)

    def cov(self, belief: Particles) -> Float[Array, "run n n"]:
        """The weighted covariance P of the particles in the tangent at x̂."""
        return _covariance(self.model.space, belief, self.mean(belief))

    def _resampled(self, belief: Particles, arrived: NDArray[np.bool_]) -> Particles:
        """The belief with equal weights in every run whose effective sample size is too small."""
        effective = 1.0 / np.exp(2.0 * belief.log_weights).sum(axis=-1)
        due = arrived & (belief.fault == 0) & (effective < self.threshold * self.size)
        if not due.any():
            return belief
        old = Particles(*(getattr(belief, name)[due] for name in Particles.__dataclass_fields__))
        start = random.uniform(old.keys, old.counter, RESAMPLING, 1)
        chosen = systematic(_weights(old), start)
        points = np.take_along_axis(old.points, chosen[..., None], axis=1)
        if self.regularization:
            points = self._jittered(old, points)
        new_points, logs = belief.points.copy(), belief.log_weights.copy()
        new_points[due], logs[due] = points, -np.log(self.size)
        code = belief.fault.copy()
        if not self.regularization:
            distinct = 1 + np.count_nonzero(np.diff(chosen, axis=-1), axis=-1)
            code[due] = np.where(distinct <= self.model.space.n, Fault.WEIGHTS, Fault.NONE)
        return _failed(replace(belief, points=new_points, log_weights=logs, fault=code))

    def _jittered(self, old: Particles, points: Array) -> Array:
        """Resampled points shrunk towards the mean and spread by the kernel."""
        space = self.model.space
        n = space.n
        bandwidth = self.regularization * (4.0 / (self.size * (n + 2.0))) ** (1.0 / (n + 4.0))
        bandwidth = min(bandwidth, 1.0)
        mean = self.mean(old)
        kernel = bandwidth**2 * _covariance(space, old, mean)
        noise = random.gaussian(old.keys, old.counter, KERNEL, kernel, self.size)
        kept = np.sqrt(1.0 - bandwidth**2) * space.minus(points, mean[:, None])
        return space.plus(mean[:, None], kept + noise)


def systematic(
    weights: Float[Array, "run point"], start: Array
) -> Int[NDArray[np.intp], "run point"]:
    """Systematic resampling: the index of the particle that each new particle is a copy of.

    Arulampalam et al. 2002, alg. 2: N equidistant points in [0, 1] are located among the cumulative
    weights, for all runs at once.

    Args:
        weights: weights of the particles.
        start: first of the equidistant points `(run, 1)`, as a fraction of their distance.
    """
    runs, size = weights.shape
    total = np.cumsum(weights, axis=-1)
    share = total / total[:, -1:]
    below = np.clip(np.ceil(size * share - start), 0, size)
    below = np.where(share < 1.0, below, size).astype(np.intp)  # whatever the rounding at its end
    rows = np.arange(runs)[:, None] * (size + 1)
    counts = np.bincount((below + rows).ravel(), minlength=runs * (size + 1))
    return np.cumsum(counts.reshape(runs, size + 1)[:, :size], axis=-1)


def _log_mean(belief: Particles, gained: Array) -> Float[Array, " run"]:
    """Log Σᵢ wᵢ exp(gᵢ) of each run; -inf where no particle has a finite g `(run, particle)`."""
    logs = belief.log_weights + gained
    peak = logs.max(axis=-1)
    shift = np.where(np.isfinite(peak), peak, 0.0)
    with np.errstate(divide="ignore"):
        total = np.log(np.exp(logs - shift[:, None]).sum(axis=-1))
    return shift + total


def _weights(belief: Particles) -> Array:
    """Weights `(run, particle)` of sum one."""
    weights = np.exp(belief.log_weights)
    return weights / weights.sum(axis=-1, keepdims=True)


def _covariance(space: Manifold, belief: Particles, mean: Array) -> Array:
    deviation = space.minus(belief.points, mean[:, None])
    return symmetrize(np.swapaxes(deviation * _weights(belief)[..., None], -1, -2) @ deviation)


def _unfinite(values: Array) -> NDArray[np.bool_]:
    """Where a particle's value `(run, particle, k)` is not finite `(run, particle)`."""
    return np.asarray(~np.isfinite(values).all(axis=-1))


def _best(belief: Particles, values: Array, dead: NDArray[np.bool_]) -> Array:
    """The value `(run, k)` of each run's heaviest particle that is not dead."""
    index = np.argmax(np.where(dead, -np.inf, belief.log_weights), axis=-1)
    return np.take_along_axis(values, index[:, None, None], axis=1)[:, 0]


def _settled(belief: Particles) -> Particles:
    """Normalize the weights, move dead particles to a live one, mark runs without a live one."""
    dead = _unfinite(belief.points)
    logs = np.where(dead, -np.inf, belief.log_weights)
    points = belief.points
    if dead.any():
        points = np.where(dead[..., None], _best(belief, points, dead)[:, None], points)
    peak = logs.max(axis=-1, keepdims=True)
    lost = ~np.isfinite(peak[:, 0])
    logs = logs - np.where(np.isfinite(peak), peak, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = logs - np.log(np.exp(logs).sum(axis=-1, keepdims=True))
    code = np.where(belief.fault, belief.fault, np.where(lost, Fault.STATE, 0)).astype(np.uint8)
    return _failed(replace(belief, points=points, log_weights=logs, fault=code))


def _failed(belief: Particles) -> Particles:
    """The belief with NaN in the runs that have a fault."""
    failed = belief.fault[:, None] > 0
    if not failed.any():
        return belief
    return replace(
        belief,
        points=np.where(failed[..., None], np.nan, belief.points),
        log_weights=np.where(failed, np.nan, belief.log_weights),
    )
