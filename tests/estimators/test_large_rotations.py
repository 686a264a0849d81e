"""A ball joint with P = 0.5 rad²: moments after a correction of 1 rad, against sampling.

A filter carries its covariance to the tangent at the new estimate. The measurement is linear in the
tangent at the prior mean, so the posterior there is the Gaussian N(δ, C) without approximation. The
first-order transport leaves a mismatch of 0.06 in the new tangent; C itself has one of 0.68. The
error of 400,000 samples is below 0.01 with probability 1 - 1e-8, and the samples are seeded.
"""

import numpy as np
import pytest

from estbench.estimators import registry
from estbench.estimators.imm import IMM, Modes, combine
from tests.helpers import DISCRETE, SAMPLED
from tests.rotations import BALL, REST, SAMPLES, BallJoint, mismatch, moments, rotation_matrix

P = np.array([[0.5, 0.1, 0.0], [0.1, 0.4, 0.15], [0.0, 0.15, 0.5]])
NO_CONTROL = np.empty((1, 0))


def test_every_filter_carries_its_covariance_to_the_new_tangent():
    A, R, y = np.eye(3)[:2], 0.05 * np.eye(2), np.array([[1.0, 0.5]])
    K = P @ A.T @ np.linalg.inv(A @ P @ A.T + R)
    delta, C = K @ y[0], P - K @ A @ P
    assert np.linalg.norm(delta) > 1.0
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((SAMPLES, 3)) @ np.linalg.cholesky(C).T
    points, equal = BALL.plus(REST, delta + noise), np.full(SAMPLES, 1 / SAMPLES)
    model = BallJoint(A, np.zeros((3, 3)), R)
    for name in DISCRETE:
        filter = registry.create(name, {"size": 20_000} if name in SAMPLED else {}, model)
        belief, _ = filter.update(filter.init(REST, P[None]), y, NO_CONTROL, 0.0)
        error, cov = moments(points, equal, filter.mean(belief))
        assert np.abs(error).max() < 0.06, name
        assert mismatch(filter.cov(belief)[0], cov) < 0.15, name
        assert mismatch(C, cov) > 0.6, name


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.7, -0.4, 0.9)])
def test_a_prediction_turns_mean_and_covariance_with_the_joint(turn):
    """Exactly, also in filters that are linearized at rest, 1 rad from the estimate."""
    model = BallJoint(np.eye(3)[:2], np.zeros((3, 3)), 0.05 * np.eye(2), turn)
    back = rotation_matrix(turn)
    for name in DISCRETE:
        filter = registry.create(name, {"size": 200} if name in SAMPLED else {}, model)
        start = filter.init(REST, P[None])
        before, _ = filter.update(start, np.array([[1.0, 0.5]]), NO_CONTROL, 0.0)
        after = filter.predict(before, NO_CONTROL, 0.0, 1.0)
        turned = BALL.plus(filter.mean(before), np.array(turn))
        np.testing.assert_allclose(BALL.minus(filter.mean(after), turned), 0.0, atol=1e-9)
        cov = back.T @ filter.cov(before) @ back
        np.testing.assert_allclose(filter.cov(after), cov, rtol=0, atol=1e-9, err_msg=name)


# The mixture of an IMM: modes 1.6 rad apart, the first with a variance of 0.5 rad²


AWAY = np.array([[0.8, 0.0, 0.0], [-0.8, 0.0, 0.0]])
COVS = np.stack([np.diag([0.02, 0.5, 0.05]), 0.1 * np.eye(3)])
WEIGHT = np.array([0.6, 0.4])


def modes():
    """Means `(1, 2, 4)`, and points `(sample, 4)` drawn from the mixture."""
    means = BALL.plus(REST, AWAY)
    rng = np.random.default_rng(1)
    chosen = rng.choice(2, SAMPLES, p=WEIGHT)
    std = np.sqrt(np.diagonal(COVS, axis1=-2, axis2=-1))
    return means[None], BALL.plus(means[chosen], std[chosen] * rng.standard_normal((SAMPLES, 3)))


def assert_moments(mean, cov, points):
    """The transport leaves a mismatch of 0.10; without it there would be one of 0.46."""
    error, expected = moments(points, np.full(SAMPLES, 1 / SAMPLES), mean)
    assert np.abs(error).max() < 0.03
    assert mismatch(cov, expected) < 0.2


def test_a_mixture_carries_each_covariance_to_the_common_tangent():
    means, points = modes()
    mean, cov = combine(BALL, means, COVS[None], WEIGHT[None])
    assert_moments(mean, cov[0], points)


@pytest.mark.parametrize("base", ["ekf", "ukf", "sr_ekf"])
def test_an_imm_mixes_and_answers_in_the_common_tangent(base):
    means, points = modes()
    model = BallJoint(np.eye(3), np.zeros((3, 3)), np.eye(3))
    # Every row of the chain is WEIGHT: both modes are mixed with these probabilities.
    imm = IMM(model, models=[model, model], base=base, transition=[WEIGHT, WEIGHT])
    filter = registry.create(base, {}, model)
    beliefs = tuple(filter.init(means[:, j], COVS[None, j]) for j in range(2))
    belief = Modes(beliefs, WEIGHT[None], np.zeros(1, np.uint8))
    assert_moments(imm.mean(belief), imm.cov(belief)[0], points)
    mixed = imm.predict(belief, NO_CONTROL, 0.0, 1.0)
    # The model neither moves nor disturbs, so each mode is the mixture itself.
    for part in mixed.beliefs:
        assert_moments(filter.mean(part), filter.cov(part)[0], points)
