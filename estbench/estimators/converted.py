"""Range and bearing converted to unbiased Cartesian measurements (source 002)."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from estbench.errors import EstimatorError, did_you_mean
from estbench.estimators.beliefs import Gaussian
from estbench.estimators.ekf import EKF
from estbench.estimators.linear import linear_update
from estbench.estimators.protocol import Innovation
from estbench.estimators.settings import names, one_of
from estbench.models.protocol import Channels
from estbench.shapes import Array, Bool, Float, Mask

Form = Literal["decorrelated", "multiplicative", "additive", "standard"]
FORMS: tuple[Form, ...] = ("decorrelated", "multiplicative", "additive", "standard")


def convert_range_bearing(
    distance: Float[Array, "*lead"],
    bearing: Float[Array, "*lead"],
    std_range: Array | float,
    std_bearing: Array | float,
    form: Form = "multiplicative",
) -> tuple[Float[Array, "*lead 2"], Float[Array, "*lead 2 2"]]:
    """Cartesian z and its R from ranges and bearings alone.

    r cos θ is biased by the factor λ = exp(-σ²/2), since E cos(θ + w) = λ cos θ. R is conditioned
    on the measurement, so it depends on the error of the measurement (see `predicted_noise`).

    Args:
        distance: measured range, m (any unit).
        bearing: measured angle from the x axis towards y, rad.
        std_range: standard deviation of the range.
        std_bearing: standard deviation σ of the bearing, rad.
        form: `multiplicative` (and `decorrelated`, which takes another R) divides by λ, unbiased
            for any noise (Longbin et al. 1998); `additive` subtracts the mean error given the
            measurement (Lerro & Bar-Shalom 1993); `standard` keeps the bias and linearizes R,
            which is valid for r σ² ≪ std_range only.
    """
    s2, r2, v = np.asarray(std_bearing) ** 2, np.asarray(distance) ** 2, np.asarray(std_range) ** 2
    cos, sin = np.cos(bearing), np.sin(bearing)
    cos2, sin2, both = cos**2, sin**2, cos * sin
    unit = np.stack(np.broadcast_arrays(cos, sin), axis=-1)
    z = np.asarray(distance)[..., None] * unit
    if form in ("multiplicative", "decorrelated"):
        growth = np.exp(s2)[..., None]  # λ⁻²
        # Given the measurement the truth's mean is λ r cos θ, its mean square
        # (r² + σ_r²)(1 ± λ⁴ cos 2θ)/2.
        shrink, power = (np.exp(s2) - 2.0) * r2, 0.5 * (r2 + v)
        double, cross = np.exp(-2.0 * s2) * (cos2 - sin2), np.exp(-2.0 * s2) * 2.0 * both
        xx = shrink * cos2 + power * (1.0 + double)
        yy = shrink * sin2 + power * (1.0 - double)
        xy = shrink * both + power * cross
        z = z * np.sqrt(growth)
    elif form == "additive":
        ch, sh, ch2, sh2 = np.cosh(s2), np.sinh(s2), np.cosh(2.0 * s2), np.sinh(2.0 * s2)
        scale = np.exp(-2.0 * s2)
        along, across = (
            r2 * (ch2 - ch) + v * (2.0 * ch2 - ch),
            r2 * (sh2 - sh) + v * (2.0 * sh2 - sh),
        )
        xx = scale * (along * cos2 + across * sin2)
        yy = scale * (along * sin2 + across * cos2)
        xy = np.exp(-4.0 * s2) * both * (v + (r2 + v) * (1.0 - np.exp(s2)))
        z = z * (1.0 - np.exp(-s2) + np.exp(-0.5 * s2))[..., None]
    else:
        xx, yy = v * cos2 + r2 * s2 * sin2, v * sin2 + r2 * s2 * cos2
        xy = (v - r2 * s2) * both
    rows = np.stack(np.broadcast_arrays(xx, xy, xy, yy), axis=-1)
    return np.broadcast_to(z, (*rows.shape[:-1], 2)), rows.reshape(*rows.shape[:-1], 2, 2)


def predicted_noise(
    position: Float[Array, "*lead 2"],
    cov: Float[Array, "*lead 2 2"],
    std_range: Array | float,
    std_bearing: Array | float,
) -> Float[Array, "*lead 2 2"]:
    """R of z = r (cos θ, sin θ)/λ, averaged over the noise and the predicted position.

    With M = E p pᵀ: E z zᵀ - M = ½ e^σ² ((tr M + σ_r²) (1 - ε) I + 2 ε (1 + σ_r²/tr M) M) - M,
    ε = exp(-2 σ²) (decorrelated conversion, Bordonaro, Willett & Bar-Shalom 2014). It does not
    depend on the measurement, so the gain is not correlated with the error of the measurement.
    Exact except for the direction in the term of σ_r².

    Args:
        position: predicted mean of p, relative to the sensor.
        cov: covariance of p.
        std_range: standard deviation of the range.
        std_bearing: standard deviation σ of the bearing, rad.
    """
    second = position[..., :, None] * position[..., None, :] + cov
    square = np.trace(second, axis1=-2, axis2=-1)[..., None, None]
    s2, v = (np.asarray(std)[..., None, None] ** 2 for std in (std_bearing, std_range))
    shrink = np.exp(-2.0 * s2)
    round_part = (square + v) * (1.0 - shrink) * np.eye(2)
    return 0.5 * np.exp(s2) * (round_part + 2.0 * shrink * (1.0 + v / square) * second) - second


@dataclass(frozen=True)
class ConvertedEKF(EKF):
    """EKF on converted measurements: range and bearing as one Cartesian reading, bias removed.

    If both arrive, their two rows become z - p, with H selecting the position p; these rows of the
    innovation are then Cartesian. Any other measurement, and one of the two alone, is treated as in
    the EKF.

    Cost per step: that of the EKF. Choose it for distant targets with coarse bearings, where the
    linearization of the bearing is the main error. Range and bearing noise are assumed independent.

    Attributes:
        model: the filter's model.
        covariance_update: form for measurements that are not converted; else Joseph's form.
        range: name of the measurement coordinate that is the range; None makes it the EKF.
        bearing: name of the bearing, from the x axis towards y, rad.
        position: names of the state coordinates x and y of the target.
        origin: position of the sensor.
        form: `decorrelated`, R from the prediction (`predicted_noise`); or R from the measurement
            (`convert_range_bearing`), which over many updates makes the filter overconfident where
            the bearing is coarse.
    """

    range: str | None = None
    bearing: str | None = None
    position: Sequence[str] = ("x", "y")
    origin: Sequence[float] = (0.0, 0.0)
    form: Form = "decorrelated"
    _seen: tuple[int, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        one_of(self, "form", FORMS)
        space, outputs = self.model.space, self.model.output().names
        chosen = []
        if (self.range is None) != (self.bearing is None):
            raise EstimatorError(
                f"ConvertedEKF: range is {self.range!r} and bearing {self.bearing!r}; give both"
            )
        names(self, "position")
        origin = np.asarray(self.origin)
        numbers = origin.dtype.kind in "fi" and origin.shape == (2,) and np.isfinite(origin).all()
        if len(self.position) != 2 or not numbers:
            raise EstimatorError(
                f"ConvertedEKF: position is {self.position!r} and origin {self.origin!r}; give two "
                "names and two numbers"
            )
        if self.range is not None:
            wanted = [("range", self.range, outputs), ("bearing", self.bearing, outputs)]
            wanted += [("position", name, space.names) for name in self.position]
            for setting, name, known in wanted:
                if name not in known:
                    raise EstimatorError(
                        f"ConvertedEKF: {setting} is {name!r}; there is none"
                        f"{did_you_mean(str(name), known)}"
                    )
            chosen = [space.index(name) for name in self.position]
        object.__setattr__(self, "_seen", tuple(chosen))

    def update(
        self,
        belief: Gaussian,
        y: Float[Array, "run ny"],
        u: Float[Array, "run nu"],
        t: float,
        channels: Channels = None,
        mask: Bool[Mask, "run m"] | None = None,
    ) -> tuple[Gaussian, Innovation]:
        """The EKF's update, with the two rows replaced where range and bearing arrived."""
        space, output = self.model.space, self.model.output(channels)
        if self.range not in output.names or self.bearing not in output.names:
            return super().update(belief, y, u, t, channels, mask)
        predicted, H = self.model.measurement_jacobian(belief.mean, u, t, channels)
        residual = output.minus(y, predicted)
        R = np.broadcast_to(self.model.measurement_noise(t, channels), (len(y), output.n, output.n))
        rows = [output.index(str(self.range)), output.index(str(self.bearing))]
        # On a real line a point's value is its difference from the point of zeros.
        polar = output.minus(y, np.zeros(output.nx))[:, rows]
        position = space.minus(belief.mean, np.zeros(space.nx))[:, list(self._seen)]
        std = np.sqrt(R[:, rows, rows])
        z, noise = convert_range_bearing(polar[:, 0], polar[:, 1], std[:, 0], std[:, 1], self.form)
        if self.form == "decorrelated":
            spread = belief.cov[:, self._seen][:, :, self._seen]
            noise = predicted_noise(position - np.asarray(self.origin), spread, *std.T)
        linear, mixed, exact = residual.copy(), R.copy(), H.copy()
        linear[:, rows] = z + np.asarray(self.origin) - position
        mixed[:, rows], mixed[:, :, rows] = 0.0, 0.0
        mixed[:, rows[0] : rows[0] + 1, rows] = noise[:, :1]
        mixed[:, rows[1] : rows[1] + 1, rows] = noise[:, 1:]
        exact[:, rows] = np.eye(space.n)[list(self._seen)]
        both = np.ones((len(y), 1), bool)
        if mask is not None:
            both = mask[:, rows[:1]] & mask[:, rows[1:]]
        residual = np.where(both, linear, residual)
        H, R = (np.where(both[..., None], a, b) for a, b in ((exact, H), (mixed, R)))
        posterior, innovation = linear_update(space, belief, residual, H, R, mask)
        return posterior, replace(innovation, gain=None)  # that of the converted measurement
