"""The information of a reading whose noise is not Gaussian, over that of a Gaussian of equal R."""

from functools import cache
from itertools import pairwise

import numpy as np
import scipy  # imports its quadrature at the first use, with much else
from scipy import special

REACH = 60.0
"""Standard deviations of the widest component up to which the density is integrated."""


@cache
def information(
    m: int, outlier_probability: float = 0.0, outlier_scale: float = 1.0, student_dof: float = 0.0
) -> float:
    """C with I = c R⁻¹, the Fisher information of y = h + v about h.

    The density of R^(-1/2) v is spherical, f(r) = (1 - p) g(r) + p g(r/s)/sᵐ, with g the standard
    normal density or that of Student's t of unit covariance. Then
    c = (1/m) ∫ f'(r)²/f(r) A_m r^(m-1) dr, A_m the area of the unit sphere.

    Args:
        m: dimension of the reading.
        outlier_probability: p.
        outlier_scale: s.
        student_dof: degrees of freedom, above 2; 0 is the normal distribution.
    """
    mixed = outlier_probability > 0 and outlier_scale != 1
    if not mixed:
        dof = student_dof
        # Lange, Little & Taylor (1989, JASA 84), with the scale that gives covariance R.
        return 1.0 if not dof else dof * (dof + m) / ((dof - 2.0) * (dof + m + 2.0))
    parts = ((1.0 - outlier_probability, 1.0), (outlier_probability, outlier_scale))
    area = 2.0 * np.pi ** (m / 2) / special.gamma(m / 2)

    def integrand(r: float) -> float:
        density = slope = 0.0
        for weight, scale in parts:
            g, dg = _density(r / scale, m, student_dof)
            density += weight * g / scale**m
            slope += weight * dg / scale ** (m + 1)
        return slope**2 / density * area * r ** (m - 1) if density > 0 else 0.0

    edges = (0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 10.0, REACH * outlier_scale)
    found = (
        scipy.integrate.quad(integrand, low, high, limit=200)[0] for low, high in pairwise(edges)
    )
    return float(sum(found)) / m


def _density(r: float, m: int, dof: float) -> tuple[float, float]:
    """The standard density of the radius r in m dimensions, not times the area, and its slope."""
    if not dof:
        g = np.exp(-0.5 * r * r) / (2.0 * np.pi) ** (m / 2)
        return g, -r * g
    size = dof - 2.0
    constant = np.exp(special.gammaln((dof + m) / 2) - special.gammaln(dof / 2))
    constant /= (np.pi * size) ** (m / 2)
    base = 1.0 + r * r / size
    g = constant * base ** (-(dof + m) / 2)
    return g, -(dof + m) * r / size / base * g
