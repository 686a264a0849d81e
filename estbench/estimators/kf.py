"""Kalman filter on a model linearized once (source 003, eq. 2-4)."""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from estbench.errors import EstimatorError
from estbench.estimators.beliefs import Gaussian, GaussianEstimator
from estbench.estimators.linear import linear_update, predicted_cov
from estbench.estimators.protocol import Innovation
from estbench.estimators.settings import has_model
from estbench.estimators.update import mark_failed
from estbench.models.protocol import Channels, Model
from estbench.shapes import Array, Bool, Float, Mask
from estbench.spaces.manifold import Manifold


@dataclass(frozen=True, eq=False)
class FixedBelief(Gaussian):
    """A Gaussian with the operating point of the linearization.

    Attributes:
        point: x₀, the initial mean of each run.
        jacobians: F for each dt and H for each set of channels that have occurred, `(run, ., n)`.
            The mapping is not changed in place.
    """

    point: Float[Array, "#run nx"]
    jacobians: Mapping[Hashable, Array]


@dataclass(frozen=True)
class KF(GaussianEstimator):
    """Kalman filter with feedthrough about one operating point; exact for a linear model.

    x̂⁻ = f(x₀, u) ⊞ F (x̂⁺ ⊖ x₀) and ŷ = h(x₀, u) ⊞ H (x̂⁻ ⊖ x₀), with F and H computed once at the
    operating point x₀, u₀. For a linear model these are A x̂ + B u and C x̂ + D u, A and C constant
    (source 003, eq. 2-3). The control enters through f and h themselves, so no B or D is needed.

    Cost per step: one transition and one measurement, and the cost of Q; n + 1 of each in the first
    step with forward differences. Choose it for a linear model, or for a robot that is regulated to
    its initial state. It is the cheapest filter.

    Attributes:
        model: the filter's model.
        u0: control of the operating point `(nu,)`; default: `u0` of the model (for a MuJoCo model
            the control of the keyframe), else zeros.
    """

    model: Model
    u0: Sequence[float] | None = None

    def __post_init__(self) -> None:
        has_model(self)
        given = getattr(self.model, "u0", None) if self.u0 is None else self.u0
        u0 = np.zeros(self.model.nu) if given is None else np.asarray(given)
        if u0.shape != (self.model.nu,) or u0.dtype.kind not in "fi" or not np.isfinite(u0).all():
            raise EstimatorError(
                f"KF: u0 is {self.u0!r}; use {self.model.nu} finite numbers, one per control"
            )
        object.__setattr__(self, "u0", tuple(u0.tolist()))

    def init(self, mean: Float[Array, "run nx"], cov: Float[Array, "run n n"]) -> FixedBelief:
        """Start from N(mean, cov); the mean is also the operating point."""
        start = super().init(mean, cov)
        return FixedBelief(start.mean, start.cov, start.fault, start.mean, {})

    def predict(
        self, belief: FixedBelief, u: Float[Array, "run nu"], t: float, dt: float
    ) -> FixedBelief:
        """x̂⁻ and P⁻ = F P⁺ Fᵀ + Q (source 003, eq. 2)."""
        model, point, key = self.model, belief.point, f"{dt:.9g}"
        if key not in belief.jacobians:
            _, F = model.transition_jacobian(point, self._operating_control(point), t, dt)
            belief = replace(belief, jacobians={**belief.jacobians, key: F})
        image = model.transition(point, u, t, dt)
        mean, F = tangent_map(
            model.space, model.space, belief.mean, point, image, belief.jacobians[key]
        )
        Q = model.process_noise(point, u, t, dt)
        cov = predicted_cov(F, belief.cov, Q)
        return cast(FixedBelief, mark_failed(belief.moved(mean, cov)))

    def update(
        self,
        belief: FixedBelief,
        y: Float[Array, "run ny"],
        u: Float[Array, "run nu"],
        t: float,
        channels: Channels = None,
        mask: Bool[Mask, "run m"] | None = None,
    ) -> tuple[FixedBelief, Innovation]:
        """x̂⁺ = x̂⁻ ⊞ K (y ⊖ ŷ) (source 003, eq. 3-4), the covariance in Joseph's form."""
        model, point = self.model, belief.point
        key = None if channels is None else tuple(channels)
        if key not in belief.jacobians:
            _, H = model.measurement_jacobian(point, self._operating_control(point), t, channels)
            belief = replace(belief, jacobians={**belief.jacobians, key: H})
        output, image = model.output(channels), model.measurement(point, u, t, channels)
        predicted, H = tangent_map(
            model.space, output, belief.mean, point, image, belief.jacobians[key]
        )
        R = model.measurement_noise(t, channels)
        return linear_update(model.space, belief, output.minus(y, predicted), H, R, mask)

    def _operating_control(self, point: Array) -> Array:
        return np.broadcast_to(np.asarray(self.u0, dtype=np.float64), (len(point), self.model.nu))


def tangent_map(
    source: Manifold,
    target: Manifold,
    x: Float[Array, "run nx"],
    point: Float[Array, "run nx"],
    image: Float[Array, "run ny"],
    slope: Float[Array, "run m n"],
) -> tuple[Float[Array, "run ny"], Float[Array, "run m n"]]:
    """A function linearized at a point, image ⊞ M (x ⊖ point), and its Jacobian at x.

    On a curved space M maps the tangent at the point to that at its image. The Jacobian maps the
    tangent at x to that at the value: J(M δ) M J(δ)⁻¹ with the reset Jacobian J, δ = x ⊖ point.

    Args:
        source: space of x.
        target: space of the value.
        x: where the linearized function is evaluated.
        point: point of the linearization.
        image: the function at the point.
        slope: M, the Jacobian at the point.
    """
    inward = source.minus(x, point)
    outward = (slope @ inward[..., None])[..., 0]
    if not source.flat:
        transposed = np.swapaxes(source.reset_jacobian(inward), -1, -2)
        solved = np.linalg.solve(transposed, slope.mT)
        slope = np.asarray(solved.mT, np.float64)
    if not target.flat:
        slope = target.reset_jacobian(outward) @ slope
    return target.plus(image, outward), slope
