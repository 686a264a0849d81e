from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from estbench.estimators.ekf import EKF
from estbench.estimators.imm import IMM
from estbench.estimators.kf import KF
from estbench.estimators.likelihood import log_likelihood
from estbench.estimators.particle import ParticleFilter
from estbench.estimators.protocol import Innovation
from estbench.estimators.robust import RobustEKF
from estbench.estimators.sr_ekf import SquareRootEKF
from estbench.models.linear import LinearModel

MODEL = LinearModel(
    np.array([[0.9, 0.1], [0.0, 0.8]]), np.eye(2), np.diag([0.1, 0.2]),
    np.array([[0.5, 0.1], [0.1, 0.3]]),
)  # fmt: skip
MASK = np.array([[True, True], [True, False], [False, True], [False, False]])
RNG = np.random.default_rng(0)
MEAN, Y = RNG.standard_normal((4, 2)), RNG.standard_normal((4, 2))
COV = np.tile(np.array([[1.0, 0.2], [0.2, 0.6]]), (4, 1, 1))
U = np.zeros((4, 0))


def textbook(mask, scale=1.0):
    """Log N(y; x̂⁻, S) of the components that arrived, with scipy."""
    out = []
    S = COV[0] * scale + MODEL.R
    for y, m, came in zip(Y, MEAN, mask):
        if came.any():
            part = S[np.ix_(came, came)]
            out.append(stats.multivariate_normal.logpdf(y[came], m[came], part))
        else:
            out.append(0.0)
    return np.array(out)


@pytest.mark.parametrize("estimator", [KF, EKF, SquareRootEKF, RobustEKF])
@pytest.mark.parametrize("mask", [None, MASK], ids=["all", "some"])
def test_gaussian_filters_have_the_density_of_what_arrived(estimator, mask):
    filter_ = estimator(MODEL)
    belief = filter_.init(MEAN, COV)
    _, innovation = filter_.update(belief, Y, U, 0.0, None, mask)
    expected = textbook(np.ones_like(MASK) if mask is None else mask)
    np.testing.assert_allclose(log_likelihood(innovation, mask), expected, rtol=1e-10, atol=1e-12)
    # The same from ν and S alone, as another's estimator gives them.
    bare = replace(innovation, factor=None)
    np.testing.assert_allclose(log_likelihood(bare, mask), expected, rtol=1e-10, atol=1e-12)


def test_one_S_for_all_runs_needs_the_mask():
    S = COV[:1] + MODEL.R
    residual = np.where(MASK, Y - MEAN, 0.0)
    nis = np.array([-2 * x for x in textbook(MASK)])
    dof = MASK.sum(axis=-1)
    for i, came in enumerate(MASK):
        part = S[0][np.ix_(came, came)]
        nis[i] -= dof[i] * np.log(2 * np.pi) + np.linalg.slogdet(part)[1]
    found = log_likelihood(Innovation(residual, S, residual, nis, dof), MASK)
    np.testing.assert_allclose(found, textbook(MASK), atol=1e-12)


def test_without_S_it_is_unknown():
    one, nothing = np.ones(3), np.empty(0)
    assert np.isnan(log_likelihood(Innovation(nothing, nothing, nothing, one, one))).all()


def test_a_run_without_a_factor_has_none_and_the_others_are_as_before():
    filter_ = KF(MODEL)
    cov = COV.copy()
    cov[1] = -5 * np.eye(2)
    _, innovation = filter_.update(filter_.init(MEAN, cov), Y, U, 0.0)
    found, expected = log_likelihood(innovation), textbook(np.ones_like(MASK))
    assert np.isnan(found[1])
    np.testing.assert_allclose(np.delete(found, 1), np.delete(expected, 1), rtol=1e-10)


def test_that_of_the_modes_is_that_of_their_mixture():
    filter_ = IMM(MODEL, process_noise_scales=[1.0, 50.0], base="kf")
    belief = filter_.predict(filter_.init(MEAN, COV), U, 0.0, 1.0)
    _, innovation = filter_.update(belief, Y, U, 1.0, None, MASK)
    each = [
        np.exp(log_likelihood(f.update(b, Y, U, 1.0, None, MASK)[1]))
        for f, b in zip(filter_._filters, belief.beliefs)
    ]
    expected = np.log(sum(p * e for p, e in zip(belief.probability.T, each)))
    np.testing.assert_allclose(log_likelihood(innovation), expected, rtol=1e-10, atol=1e-12)


def test_that_of_particles_tends_to_the_integral():
    """The error of log of a mean over 20,000 particles is some 0.01: 0.1 is ten times as much."""
    filter_ = ParticleFilter(MODEL, size=20_000)
    _, innovation = filter_.update(filter_.init(MEAN, COV), Y, U, 0.0, None, MASK)
    np.testing.assert_allclose(log_likelihood(innovation), textbook(MASK), atol=0.1)
    assert log_likelihood(innovation)[3] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("method", ["gate_components", "gate"])
def test_gated_components_are_counted_and_stay_in_the_likelihood(method):
    filter_ = RobustEKF(MODEL, method=method)
    y = Y.copy()
    y[:, 0] = MEAN[:, 0] + 100.0
    _, innovation = filter_.update(filter_.init(MEAN, COV), y, U, 0.0, None, MASK)
    expected = [1, 1, 0, 0] if method == "gate_components" else [2, 1, 0, 0]
    assert innovation.gated is not None
    np.testing.assert_array_equal(innovation.gated, expected)
    assert (log_likelihood(innovation)[:2] < -1000).all()
