"""Interacting multiple model filter (Bar-Shalom, Li & Kirubarajan 2001, sec. 11.6.6)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from estbench.errors import DimensionError, EstimatorError
from estbench.estimators import registry
from estbench.estimators.beliefs import Fault, restart, start
from estbench.estimators.likelihood import log_likelihood
from estbench.estimators.protocol import Estimator, Innovation
from estbench.estimators.settings import has_model, in_range, table
from estbench.models.protocol import Channels, Model
from estbench.models.scaled import ScaledNoise
from estbench.shapes import Array, Bool, Faults, Float, Keys, Mask, UInt
from estbench.spaces.linalg import cholesky, solve_lower, symmetrize
from estbench.spaces.manifold import Manifold


@dataclass(frozen=True, eq=False)
class Modes:
    """The beliefs of the modes and their probabilities.

    Attributes:
        beliefs: one belief of the base filter per mode.
        probability: μ; NaN in a failed run.
        fault: `Fault` of each run; a run fails when all its modes have failed.
    """

    beliefs: tuple[Any, ...]
    probability: Float[Array, "run mode"]
    fault: UInt[Faults, " run"]


@dataclass(frozen=True)
class IMM:
    """Interacting multiple models: a bank of filters; the active model is a Markov chain.

    Before each prediction the modes' Gaussians are mixed by their probabilities (eq. 11.6.6-7 to
    -10), after each update the probabilities weighted by the likelihoods (eq. 11.6.6-14, -15). The
    answer is the moment-matched Gaussian (eq. 11.6.6-16, -17), all on the state's manifold.

    Cost per step: that of the base filter times the number of modes. Choose it where the robot
    has a few distinct modes of operation (a manoeuvre, a slipping wheel, a degraded actuator).

    A mode that fails gets probability zero in that run; the next mixing starts it again.

    Attributes:
        model: the model from which the modes are derived, and whose state is estimated.
        models: the modes' models on the same state space; by default the one model for all. In a
            scenario a list of tables, each what that mode changes of the filter's model, like
            `filter.set`.
        transition: probability of going from mode i to mode j at a prediction `(mode, mode)`; rows
            sum to one. By default `switching` decides.
        base: registered name (or `package.module:Name`) of the filter in each mode.
        process_noise_scales: factors on Q, one per mode; default 1 and 100, with `models` all 1.
        switching: probability of leaving a mode at a prediction; the other modes are equally
            likely.
        settings: settings of the base filter.
    """

    model: Model
    models: Sequence[Model] | None = None
    transition: Sequence[Sequence[float]] | Array | None = None
    base: str = "ekf"
    process_noise_scales: Sequence[float] | None = None
    switching: float = 0.05
    settings: Mapping[str, Any] = field(default_factory=dict)
    _filters: tuple[Estimator, ...] = field(init=False, repr=False)
    _chain: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        has_model(self)
        in_range(self, "switching", 0.0, 1.0)
        table(self, "settings")
        filters = tuple(registry.create(self.base, self.settings, m) for m in self._modes())
        object.__setattr__(self, "_filters", filters)
        object.__setattr__(self, "_chain", self._markov_chain(len(filters)))

    def init(
        self,
        mean: Float[Array, "run nx"],
        cov: Float[Array, "run n n"],
        keys: UInt[Keys, " run"] | None = None,
    ) -> Modes:
        """Start every mode from N(mean, cov), with equal probabilities and equal random numbers."""
        count = len(self._filters)
        beliefs = tuple(start(f, mean, cov, keys) for f in self._filters)
        probability = np.full((len(mean), count), 1.0 / count)
        return self._settled(Modes(beliefs, probability, np.zeros(len(mean), np.uint8)))

    def predict(self, belief: Modes, u: Float[Array, "run nu"], t: float, dt: float) -> Modes:
        """Mix the modes, then predict each by its model."""
        means, covs = self._moments(belief)
        joint = belief.probability[:, :, None] * self._chain  # P(was i, is j)
        probability = joint.sum(axis=1)
        reached = probability[:, None] > 0
        share = np.where(reached, joint, belief.probability[:, :, None])
        share = share / np.where(reached, probability[:, None], 1.0)
        beliefs = []
        for j, filter in enumerate(self._filters):
            mixed = combine(self.model.space, means, covs, share[:, :, j])
            mode = restart(filter, belief.beliefs[j], *mixed)
            beliefs.append(filter.predict(mode, u, t, dt))
        return self._settled(replace(belief, beliefs=tuple(beliefs), probability=probability))

    def update(
        self,
        belief: Modes,
        y: Float[Array, "run ny"],
        u: Float[Array, "run nu"],
        t: float,
        channels: Channels = None,
        mask: Bool[Mask, "run m"] | None = None,
    ) -> tuple[Modes, Innovation]:
        """Update each mode, then weight it by its likelihood N(ν; 0, S).

        The innovation is that of the mixture of the modes' predicted measurements, moment-matched.
        """
        results = [
            filter.update(b, y, u, t, channels, mask)
            for filter, b in zip(self._filters, belief.beliefs)
        ]
        innovations = [innovation for _, innovation in results]
        likelihood = np.stack([log_likelihood(i, mask) for i in innovations], axis=-1)
        likelihood = np.where(np.isfinite(likelihood), likelihood, -np.inf)
        peak = likelihood.max(axis=-1, keepdims=True)
        peak = np.where(np.isfinite(peak), peak, 0.0)
        weight = np.exp(likelihood - peak)
        posterior = replace(
            belief,
            beliefs=tuple(b for b, _ in results),
            probability=belief.probability * weight,
        )
        prior = np.where(np.isfinite(likelihood), belief.probability, 0.0)
        total = prior.sum(axis=-1, keepdims=True)
        prior = np.where(total > 0, prior / np.where(total > 0, total, 1.0), np.nan)
        with np.errstate(divide="ignore"):
            mixture = peak[:, 0] + np.log((prior * weight).sum(axis=-1))
        return self._settled(posterior), _mixed_innovation(innovations, prior, mixture)

    def mean(self, belief: Modes) -> Float[Array, "run nx"]:
        """The mean x̂ of the mixture."""
        return combine(self.model.space, *self._moments(belief), belief.probability)[0]

    def cov(self, belief: Modes) -> Float[Array, "run n n"]:
        """The covariance P of the mixture."""
        return combine(self.model.space, *self._moments(belief), belief.probability)[1]

    def _moments(self, belief: Modes) -> tuple[Array, Array]:
        """Means `(run, mode, nx)` and covariances `(run, mode, n, n)` of the modes."""
        pairs = list(zip(self._filters, belief.beliefs))
        return (
            np.stack([filter.mean(b) for filter, b in pairs], axis=1),
            np.stack([filter.cov(b) for filter, b in pairs], axis=1),
        )

    def _settled(self, belief: Modes) -> Modes:
        """Probabilities normalized; failed modes at zero; runs without any mode marked."""
        means, covs = self._moments(belief)
        alive = np.isfinite(means).all(axis=-1) & np.isfinite(covs).all(axis=(-2, -1))
        probability = np.where(alive, belief.probability, 0.0)
        total = probability.sum(axis=-1, keepdims=True)
        faults = [getattr(b, "fault", belief.fault) for b in belief.beliefs]
        cause = np.max(faults, axis=0)
        new = np.where(total[:, 0] > 0, 0, np.where(cause, cause, Fault.STATE))
        code = np.where(belief.fault, belief.fault, new).astype(np.uint8)
        # A sum within rounding of one is left alone: an update without data changes no bit.
        scale = np.where((total > 0) & (np.abs(total - 1.0) > 1e-14), total, 1.0)
        probability = np.where(code[:, None] > 0, np.nan, probability / scale)
        return replace(belief, probability=probability, fault=code)

    def _modes(self) -> list[Model]:
        """The model of each mode."""
        given, models = self.process_noise_scales, self.models
        if models is not None:
            self._check_spaces(models)
        if given is None:
            given = (1.0, 100.0) if models is None else (1.0,) * len(models)
        scales = np.atleast_1d(np.asarray(given))
        models = [self.model] * scales.size if models is None else models
        numbers = scales.shape == (len(models),) and scales.size > 0 and scales.dtype.kind in "fi"
        if not numbers or not ((scales > 0) & np.isfinite(scales)).all():
            raise EstimatorError(
                f"IMM: process_noise_scales is {given!r}; use a list of positive numbers, one per "
                "mode"
            )
        return [m if q == 1.0 else ScaledNoise(m, float(q)) for m, q in zip(models, scales)]

    def _check_spaces(self, models: Sequence[Model]) -> None:
        known = self.model.space.names
        listed = isinstance(models, Sequence) and len(models) > 0
        if not (listed and all(isinstance(m, Model) and m.space.names == known for m in models)):
            what = f"a list of {len(models)}" if isinstance(models, Sequence) else repr(models)
            raise EstimatorError(
                f"IMM: models is {what}; use at least one model, all of them with the state "
                f"coordinates {', '.join(known)}"
            )

    def _markov_chain(self, count: int) -> Array:
        if self.transition is None:
            leave = self.switching / (count - 1) if count > 1 else 0.0
            return np.full((count, count), leave) + (1.0 - leave * count) * np.eye(count)
        try:
            chain = np.asarray(self.transition, dtype=np.float64)
        except (TypeError, ValueError):
            raise EstimatorError(
                f"IMM: transition is {self.transition!r}; use rows of numbers, one row a mode"
            ) from None
        if chain.shape != (count, count):
            raise DimensionError(
                f"IMM: transition has shape {chain.shape}; use {(count, count)}, one row a mode"
            )
        if not ((chain >= 0).all() and np.allclose(chain.sum(axis=1), 1.0)):
            raise EstimatorError(
                f"IMM: transition is {chain.tolist()}; use probabilities, each row with sum 1"
            )
        return chain


def combine(
    space: Manifold,
    means: Float[Array, "run mode nx"],
    covs: Float[Array, "run mode n n"],
    weight: Float[Array, "run mode"],
) -> tuple[Float[Array, "run nx"], Float[Array, "run n n"]]:
    """Mean `(run, nx)` and covariance `(run, n, n)` of a Gaussian mixture on a manifold.

    A component of weight zero counts for nothing, even if it is not finite.

    Args:
        space: the state's manifold.
        means: `(run, mode, nx)`.
        covs: `(run, mode, n, n)`, each in the tangent at its own mean.
        weight: `(run, mode)`, of sum one; NaN gives NaN.
    """
    absent = weight == 0
    heaviest = np.argmax(weight, axis=-1)[:, None, None]
    means = np.where(absent[..., None], np.take_along_axis(means, heaviest, axis=1), means)
    covs = np.where(absent[..., None, None], 0.0, covs)
    mean = space.mean(means, weight)
    mean = np.where(np.isnan(weight[:, :1]), np.nan, mean)
    away = space.minus(means, mean[:, None])
    carried = space.transport(covs, space.minus(mean[:, None], means))
    spread = carried + away[..., :, None] * away[..., None, :]
    return mean, symmetrize((weight[..., None, None] * spread).sum(axis=1))


def _mixed_innovation(
    innovations: Sequence[Innovation], weight: Array, mixture: Array
) -> Innovation:
    """ν and S of the mixture of predicted measurements with the modes' prior probabilities.

    Args:
        innovations: of the modes.
        weight: prior probabilities `(run, mode)`.
        mixture: log of the mixture's density at the reading `(run,)`.
    """
    residuals = np.stack([i.residual for i in innovations], axis=1)
    covs = np.stack([i.cov for i in innovations], axis=1)
    residual, cov = combine(Manifold.euclidean(residuals.shape[-1]), residuals, covs, weight)
    lower = cholesky(cov)
    white = solve_lower(lower, residual[..., None])[..., 0]
    nis = np.einsum("ij,ij->i", white, white)
    return Innovation(residual, cov, white, nis, innovations[0].dof, lower, mixture)
