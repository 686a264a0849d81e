"""Dynamically iterated posterior linearization filter (Kullberg, Skog & Hendeby 2023)."""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from estbench.errors import EstimatorError
from estbench.estimators.beliefs import start
from estbench.estimators.iplf import IPLF
from estbench.estimators.posterior_linearization import Measured, Whitened, condition
from estbench.estimators.protocol import Innovation
from estbench.estimators.settings import whole
from estbench.estimators.ukf import MEASUREMENT, PREDICTION, failed_factor
from estbench.estimators.update import mark_failed
from estbench.models.protocol import Channels
from estbench.shapes import Array, Bool, Faults, Float, Keys, Mask, UInt
from estbench.spaces.linalg import cholesky, identity, solve_lower_transposed, symmetrize
from estbench.spaces.semidefinite import psd_root


@dataclass(frozen=True, eq=False)
class Transition:
    """The transition that led to a prior, to be linearized again.

    Attributes:
        before: the base filter's belief at its start, N(x̂, L Lᵀ).
        root: L.
        u: the control.
        span: its start and length in s.
        noise: a square root of Q.
    """

    before: Any
    root: Float[Array, "run n n"]
    u: Float[Array, "run nu"]
    span: Float[Array, "run 2"]
    noise: Float[Array, "run n n"]


@dataclass(frozen=True, eq=False)
class Linearized:
    """A prior x̂⁻ ⊞ T η by a linearized transition from x̂ ⊞ L ζ, with ζ, η ~ N(0, I).

    Attributes:
        mean: x̂⁻.
        root: T.
        cross: Cov(ζ, η).
    """

    mean: Float[Array, "run nx"]
    root: Float[Array, "run n n"]
    cross: Float[Array, "run n n"]


@dataclass(frozen=True, eq=False)
class DynamicBelief:
    """A belief of the base filter and, before the update, how it came about.

    Attributes:
        now: the base filter's belief.
        transition: None after an update.
        prior: None after an update.
    """

    now: Any
    transition: Transition | None = None
    prior: Linearized | None = None

    @property
    def fault(self) -> UInt[Faults, " run"]:
        """`Fault` of each run."""
        return self.now.fault


@dataclass(frozen=True)
class DIPLF(IPLF):
    """The `iplf` whose transition is linearized again as well, about the smoothed last state.

    A measurement says something of the state before the transition too. Each iteration takes the
    posterior back by one step (x = x̂ ⊞ L ζ given y), linearizes the transition about it, predicts
    by this linearization, and repeats the update. It is the dynamically iterated form of the
    `iplf` of Kullberg, Skog & Hendeby, "Iterated filters for nonlinear transition models" (2023,
    arXiv:2302.13871).

    Cost per step: the base filter's transitions `iterations` + 1 times, and its measurements up to
    `measurement_iterations` as often. Choose it where a reading is precise against what the
    transition makes of the belief, as at a touch-down.

    Attributes:
        base: the filter whose points are used, one of `bases`; no weight may be negative.
        iterations: how often the transition is linearized again at most.
        measurement_iterations: linearizations of h in each of them, as `iterations` of the `iplf`.
    """

    base: str = "rotated_ukf"
    iterations: int = 1
    measurement_iterations: int = 1
    bases: ClassVar[tuple[str, ...]] = ("rotated_ukf", "ukf", "ckf", "ghkf")

    def __post_init__(self) -> None:
        super().__post_init__()
        whole(self, "measurement_iterations", 1, 1000)
        if self._filter.rule.cov_weights.min() < 0:
            raise EstimatorError(
                f"{type(self).__name__}: a weight of the points of {self.base} is negative; use "
                "settings with positive weights (alpha = 1, centre_weight of at least 0)"
            )

    def init(
        self,
        mean: Float[Array, "run nx"],
        cov: Float[Array, "run n n"],
        keys: UInt[Keys, " run"] | None = None,
    ) -> DynamicBelief:
        """The base filter's start; `keys` are for one that draws random numbers."""
        return DynamicBelief(start(self._filter, mean, cov, keys))

    def predict(
        self, belief: DynamicBelief, u: Float[Array, "run nu"], t: float, dt: float
    ) -> DynamicBelief:
        """x̂⁻ and P⁻ of the base filter, in the form that can be linearized again."""
        before = belief.now
        Q = self.model.process_noise(before.mean, u, t, dt)
        root = psd_root(before.cov)
        noise = np.broadcast_to(psd_root(Q), root.shape)
        span = np.tile([t, dt], (len(root), 1))
        transition = Transition(before, root, u, span, noise)
        prior = self._linearized(transition, np.zeros(root.shape[:-1]), None)
        cov = symmetrize(prior.root @ prior.root.mT)
        now = mark_failed(
            replace(before, mean=prior.mean, cov=cov), failed_factor(root, before.cov)
        )
        return DynamicBelief(self._filter.drawn(now), transition, prior)

    def update(
        self,
        belief: DynamicBelief,
        y: Float[Array, "run ny"],
        u: Float[Array, "run nu"],
        t: float,
        channels: Channels = None,
        mask: Bool[Mask, "run m"] | None = None,
    ) -> tuple[DynamicBelief, Innovation]:
        """The posterior by the last linearization; ν, S and NIS from the first."""
        now, transition, prior = belief.now, belief.transition, belief.prior
        rule = self.rule_at(now, MEASUREMENT)
        how = rule, self.omega, self.measurement_iterations, self.tolerance
        measured = Measured(y, u, t, channels, mask, *how)
        if transition is None or prior is None:
            nothing = np.zeros_like(now.cov)
            prior = Linearized(now.mean, psd_root(now.cov), nothing)
        lost = failed_factor(prior.root, now.cov)
        found = condition(self.model, prior.mean, prior.root, measured)
        innovation = found.innovation
        if transition is not None:
            arrived = (innovation.dof > 0) & (now.fault == 0) & (found.fault == 0)
            prior, found = self._iterated(transition, prior, found, measured, arrived)
        posterior = self._posterior(replace(now, mean=prior.mean), prior.root, found, lost)
        return DynamicBelief(posterior), innovation

    def mean(self, belief: DynamicBelief) -> Float[Array, "run nx"]:
        """The estimate x̂."""
        return belief.now.mean

    def cov(self, belief: DynamicBelief) -> Float[Array, "run n n"]:
        """The covariance P."""
        return belief.now.cov

    def _iterated(
        self,
        transition: Transition,
        prior: Linearized,
        found: Whitened,
        measured: Measured,
        active: Bool[Mask, " run"],
    ) -> tuple[Linearized, Whitened]:
        """The prior and the posterior by the last linearization of the transition."""
        eye, before = identity(self.model.space.n), np.zeros(found.mean.shape)
        for _ in range(self.iterations):
            zeta = (prior.cross @ found.mean[..., None])[..., 0]
            active = active & (np.abs(zeta - before).max(axis=-1) > self.tolerance)
            if not active.any():
                break
            cov = eye - prior.cross @ (eye - found.cov) @ prior.cross.mT
            again = self._linearized(transition, zeta, cholesky(symmetrize(cov)))
            new = condition(self.model, again.mean, again.root, measured)
            good = np.isfinite(again.mean).all(axis=-1) & np.isfinite(new.mean).all(axis=-1)
            active = active & good & (new.fault == 0)
            prior, found = _mixed(active, again, prior), _mixed(active, new, found)
            before = zeta
        return prior, found

    def _linearized(
        self,
        transition: Transition,
        zeta: Float[Array, "run n"],
        factor: Float[Array, "run n n"] | None,
    ) -> Linearized:
        """The transition linearized about N(ζ, G Gᵀ) in whitened coordinates; G is I by default.

        The regression on the points is f̄ ⊞ (A (· - ζ) + e), Cov(e) = Ω. So x̂⁻ = f̄ ⊞ (-A ζ) and
        P⁻ = A Aᵀ + (1 + ω) Ω + Q = T Tᵀ, by QR of the square roots of its parts.
        """
        space, n = self.model.space, self.model.space.n
        rule = self.rule_at(transition.before, PREDICTION)
        points = rule.points if factor is None else rule.points @ factor.mT
        points = (zeta[:, None] + points) @ transition.root.mT
        images = self._moved(space.plus(transition.before.mean[:, None], points), transition)
        mean, residual = rule.residuals(space, images)
        slope = rule.cross(residual, np.broadcast_to(rule.points, points.shape))
        error = residual - rule.points @ slope.mT
        weights = np.sqrt((1.0 + self.omega) * rule.cov_weights)
        noise = np.concatenate([(error * weights[:, None]).mT, transition.noise], axis=-1)
        if factor is not None:
            slope = solve_lower_transposed(factor, slope.mT).mT
        shift = -(slope @ zeta[..., None])[..., 0]
        parts = np.concatenate([slope, noise], axis=-1)
        if not space.flat:
            parts = space.reset_jacobian(shift) @ parts
        orthogonal, upper = np.linalg.qr(parts.mT)
        return Linearized(space.plus(mean, shift), upper.mT, orthogonal[:, :n])

    def _moved(self, points: Array, transition: Transition) -> Array:
        """The images of points `(run, point, nx)`; rows may have different intervals."""
        spans = np.unique(transition.span, axis=0)
        if len(spans) == 1:
            return self.model.transition(points, transition.u, *spans[0].tolist())
        images = np.full_like(points, np.nan)
        for span in spans:
            rows = (transition.span == span).all(axis=-1)
            images[rows] = self.model.transition(points[rows], transition.u[rows], *span.tolist())
        return images


def _mixed(mask: Mask, new: Any, old: Any) -> Any:
    """The fields of `new` in the runs of the mask, and those of `old` in the others."""
    parts = {}
    for name in ("mean", "cov", "root", "cross", "fault"):
        if hasattr(old, name):
            a, b = getattr(new, name), getattr(old, name)
            parts[name] = np.where(mask.reshape(-1, *[1] * (b.ndim - 1)), a, b)
    return replace(old, **parts)
