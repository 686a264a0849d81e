"""The Fisher information of noise that is not Gaussian, against numbers from the literature."""

import numpy as np
import pytest
from scipy import integrate, stats

from estbench.bounds.noise import information


def test_gaussian_noise():
    assert information(3) == 1.0
    assert information(2, 0.3, 1.0) == 1.0  # outliers of the same size


def test_students_noise():
    """I = (ν + m)/(ν + m + 2) of the scale's inverse (Lange, Little & Taylor 1989)."""
    assert information(1, student_dof=5.0) == pytest.approx(6 / 8 * 5 / 3)
    assert information(3, student_dof=4.0) == pytest.approx(7 / 9 * 2)
    scale = np.sqrt(3 / 5)

    def integrand(x):
        step = 1e-5
        logs = [stats.t.logpdf(x + s, 5.0, scale=scale) for s in (-step, step)]
        return ((logs[1] - logs[0]) / (2 * step)) ** 2 * stats.t.pdf(x, 5.0, scale=scale)

    assert information(1, student_dof=5.0) == pytest.approx(
        integrate.quad(integrand, -60, 60, limit=200)[0], rel=1e-5
    )


@pytest.mark.parametrize("dof", [0.0, 5.0])
def test_outliers(dof):
    """By numerical differentiation of the mixture's logarithm, in one dimension."""
    kind = stats.norm() if not dof else stats.t(dof, scale=np.sqrt((dof - 2) / dof))
    p, s = 0.05, 20.0

    def log(x):
        return np.log((1 - p) * kind.pdf(x) + p * kind.pdf(x / s) / s)

    x = np.linspace(-400, 400, 400_001)
    density = np.exp(log(x))
    expected = np.trapezoid(np.gradient(log(x), x) ** 2 * density, x)
    assert information(1, p, s, dof) == pytest.approx(expected, rel=1e-4)
    assert 0.9 < information(1, p, s, dof) / information(1, student_dof=dof) < 1 - p


def test_outliers_of_several_axes_at_once_are_recognized_better():
    """In many dimensions a reading tells whether it is an outlier: only these are lost."""
    found = [information(m, 0.1, 20.0) for m in (1, 3, 6)]
    assert np.all(np.diff(found) > 0)
    assert found[-1] == pytest.approx(0.9, abs=0.005)


def test_small_outliers_have_the_information_of_the_mixture():
    assert information(2, 1e-12, 3.0) == pytest.approx(1.0, abs=1e-9)
