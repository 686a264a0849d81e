"""R and imperfections of a channel from its section, which uses the parameters of datasheets."""

from collections.abc import Sequence

import numpy as np

from estbench.errors import CovarianceError, DimensionError, ScenarioError
from estbench.scenario.channels import ChannelSection
from estbench.sensors.imperfections import Imperfections
from estbench.shapes import Array, Float
from estbench.spaces.linalg import is_positive_definite, is_positive_semidefinite
from estbench.spaces.manifold import Manifold

# Standard deviation assumed for a sensor without noise, by unit: typical of a good robot.
DEFAULT_NOISE = {
    "rad": 0.01, "m": 0.01, "rad/s": 0.02, "m/s": 0.02, "m/s²": 0.1, "rad/s²": 0.5, "N": 0.5,
    "N m": 0.1, "T": 0.01, "pixel": 1.0, "s": 1e-3,
}  # fmt: skip
FALLBACK_NOISE = 0.01
ALLAN_PEAK = 0.6173
"""Peak Allan deviation of a Gauss-Markov drift, at 1.89 correlation times, over its std."""
ALLAN_FLOOR = 0.6643
"""Minimum of the Allan deviation over the bias instability, sqrt(2 ln 2/π) (IEEE Std 952)."""


def matrix(
    given: Sequence[Sequence[float]],
    space: Manifold,
    where: str,
    symbol: str,
    definite: bool = True,
) -> Float[Array, "n n"]:
    """A full covariance from a scenario, in the tangent space of `space`.

    Raises:
        DimensionError: the shape is not `(n, n)`.
        CovarianceError: the matrix is not symmetric positive definite, or semidefinite.
    """
    cov = np.asarray(given, dtype=np.float64)
    if cov.shape != (space.n, space.n):
        raise DimensionError(
            f"{where} has shape {cov.shape}; expected {(space.n, space.n)} "
            f"({', '.join(space.names)})"
        )
    if not (is_positive_definite if definite else is_positive_semidefinite)(cov):
        kind = "definite" if definite else "semidefinite"
        raise CovarianceError(f"{where} ({symbol}) is not symmetric positive {kind}")
    return cov


def covariance(
    section: ChannelSection,
    where: str,
    space: Manifold,
    mjcf_std: Float[Array, " m"],
    rate: float,
    exact: bool = False,
) -> tuple[Float[Array, "m m"], Float[Array, " m"]]:
    """R, and the assumed std, 0 where the scenario or the MJCF gives one.

    Args:
        section: the section of the channel.
        where: name of the section, for messages.
        space: the manifold of its readings.
        mjcf_std: std that the MJCF gives each axis, 0 for none.
        rate: mean rate of the readings, Hz, for `noise_density`.
        exact: whether a std of 0 is allowed.

    Raises:
        CovarianceError, DimensionError: R is not positive definite or has the wrong size.
        ScenarioError: more than one of noise, noise_density and cov is given.
    """
    given = [k for k in ("noise", "noise_density", "cov") if getattr(section, k) is not None]
    if len(given) > 1:
        raise ScenarioError(f"{where} has {' and '.join(given)}; give one of them")
    none = np.zeros(space.n)
    if section.cov is not None:
        return matrix(section.cov, space, f"{where}.cov", "R"), none
    assumed = none
    if section.noise_density is not None:
        std = np.array([section.noise_density * np.sqrt(rate)])
    elif section.noise is not None:
        std = np.atleast_1d(np.asarray(section.noise, dtype=np.float64))
    else:
        usual = np.array([DEFAULT_NOISE.get(unit, FALLBACK_NOISE) for unit in space.units])
        assumed = np.where(mjcf_std == 0.0, usual, 0.0)
        std = mjcf_std + assumed
    if len(std) not in (1, space.n):
        raise DimensionError(
            f"{where}.noise has {len(std)} values; expected 1 or {space.n} "
            f"({', '.join(space.names)})"
        )
    if not ((std >= 0) if exact else (std > 0)).all():
        believed = where.startswith("filter.")
        other = (
            "" if believed else f" (or 0 with filter.{where}.noise for what the filter believes)"
        )
        raise CovarianceError(
            f"{where}.noise is {std.min():g}; R must be positive definite, so use a std above 0"
            f"{other}"
        )
    return np.diag(np.broadcast_to(std, (space.n,)) ** 2), assumed


def imperfections(
    section: ChannelSection, where: str, space: Manifold, cutoff: Float[Array, " m"]
) -> Imperfections | None:
    """The imperfections in a section, or None if it has white noise only.

    Args:
        section: the section of the channel.
        where: name of the section, for messages.
        space: the manifold of its readings.
        cutoff: saturation that the MJCF gives each axis, infinite for none.

    Raises:
        DimensionError: the count of values is neither 1 nor m.
        ScenarioError: an imperfection that does not apply to this sensor.
    """

    def axes(name: str) -> Array:
        value = np.atleast_1d(np.asarray(getattr(section, name), dtype=np.float64))
        if len(value) not in (1, space.n):
            raise DimensionError(f"{where}.{name} has {len(value)} values; expected 1 or {space.n}")
        return np.broadcast_to(value, (space.n,)).copy()

    _check(section, where, space)
    drift, step = axes("drift"), axes("quantization")
    if section.bias_instability is not None:
        drift = np.full(space.n, section.bias_instability * ALLAN_FLOOR / ALLAN_PEAK)
    if section.counts_per_revolution is not None:
        step = np.full(space.n, 2 * np.pi / section.counts_per_revolution)
    limit = cutoff if section.cutoff is None else np.full(space.n, section.cutoff)
    built = Imperfections(
        bias=axes("bias"),
        walk=axes("bias_walk"),
        drift=drift,
        drift_time=section.drift_time,
        scale_factor=axes("scale_factor"),
        misalignment=section.misalignment,
        quantization=step,
        cutoff=limit,
        deadband=axes("deadband"),
        outlier_probability=section.outlier_probability,
        outlier_scale=section.outlier_scale,
        student_dof=section.student_dof or 0.0,
        dropout=section.dropout,
        dropout_length=section.dropout_length,
        stuck=section.stuck,
        stuck_length=section.stuck_length,
    )
    ideal = not (built.normals(1) or built.uniforms() or built.constants(1))
    transfer = np.isfinite(limit).any() or built.quantization.any() or built.deadband.any()
    return None if ideal and not transfer else built


def _check(section: ChannelSection, where: str, space: Manifold) -> None:
    """Refuse settings that exclude each other or do not apply to this sensor.

    Raises:
        ScenarioError: there are such settings.
    """
    for pair in (("drift", "bias_instability"), ("quantization", "counts_per_revolution")):
        if all(np.any(getattr(section, name) or 0.0) for name in pair):
            raise ScenarioError(f"{where} has {' and '.join(pair)}; give one of them")
    if section.misalignment and space.n != 3:
        raise ScenarioError(f"{where}.misalignment needs a three-axis sensor; this has {space.n}")
    if section.counts_per_revolution is not None and set(space.units) != {"rad"}:
        raise ScenarioError(
            f"{where}.counts_per_revolution is for angles, not {space.units[0]}; use quantization"
        )
    odds = section.dropout / (1.0 - section.dropout)
    if section.dropout_length > 1.0 and odds > section.dropout_length:
        raise ScenarioError(
            f"{where}.dropout_length is {section.dropout_length:g} readings, too short for gaps "
            f"that lose {section.dropout:g} of them; use at least {odds:g}, or 1 for no gaps"
        )
    if not space.flat:
        names = ("scale_factor", "misalignment", "quantization", "counts_per_revolution", "cutoff",
                 "deadband")  # fmt: skip
        for name in names:
            if np.any(getattr(section, name) or 0.0):
                raise ScenarioError(f"{where}.{name} has no meaning for a quaternion; remove it")
