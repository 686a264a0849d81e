"""The bound against closed forms of the literature, and against another library's."""

from datetime import datetime, timedelta

import numpy as np
import pytest

from estbench.bounds.expectation import posterior_bound
from estbench.models.function import FunctionModel
from estbench.models.linear import LinearModel
from examples.how_good import ASIDE, MEAN, NOISE, PRIOR, STEPS, distance, fall

SIGMA = 0.02
"""Of a bearing, rad."""


def test_the_alpha_beta_filter_of_tracking_index_1():
    """Kalata (1984, IEEE Trans. AES 20(2)): alpha = 3/4 and beta = 1/2 where T² sigma_v = sigma_w.

    The covariance in units of sigma_w and T is then [[alpha, beta], [beta, 1]] (Bar-Shalom, Li &
    Kirubarajan 2001, sec. 6.5.3: p22 = beta (alpha - beta/2)/(1 - alpha)).
    """
    gamma = np.array([[0.5], [1.0]])
    model = LinearModel(
        np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0, 0.0]]), gamma @ gamma.T, np.eye(1)
    )
    x = np.zeros((61, 1, 2))
    found = posterior_bound(model, np.zeros(2), 100 * np.eye(2), np.arange(61.0), x)
    np.testing.assert_allclose(found.cov[-1], [[0.75, 0.5], [0.5, 1.0]], rtol=1e-9)


def bearings(observer) -> FunctionModel:
    """A point that moves with constant velocity, seen under a bearing by a moving observer."""
    A = np.eye(4) + np.diag([1.0, 1.0], 2)

    def h(x, u, t):
        away = x[..., :2] - observer(t)
        return np.arctan2(away[..., :1], away[..., 1:])

    return FunctionModel(lambda x, u, t, dt: x @ A.T, h, np.zeros((4, 4)), SIGMA**2 * np.eye(1))


def test_bearings_from_all_sides():
    """N bearings from equal angles at the distance r have the information N/(2 r² sigma²).

    On each axis; it is the best geometry (Bishop, Fidan, Anderson, Dogancay & Pathirana 2010,
    Automatica 46(3), sec. 4).
    """
    count, r = 8, 3.0

    def observer(t):
        angle = 2 * np.pi * t / count + 0.3
        return r * np.array([np.sin(angle), np.cos(angle)])

    model = bearings(observer)
    P0, times = np.diag([1.0, 1.0, 0.0, 0.0]), np.arange(count + 1.0)  # it stands still
    found = posterior_bound(model, np.zeros(4), P0, times, np.zeros((count + 1, 1, 4)))
    expected = 1 / (1 + count / (2 * r**2 * SIGMA**2))
    np.testing.assert_allclose(found.cov[-1][:2, :2], expected * np.eye(2), rtol=1e-6, atol=1e-12)


def test_bearings_only_target_motion_analysis():
    """The inverse of the information of all bearings (Nardone, Lindgren & Gong 1984, sec. III).

    IEEE Trans. Automatic Control 29(9). Along a straight course of the observer the range cannot be
    seen: a target whose relative state is larger by a factor has the same bearings.
    """
    steps, x0 = 20, np.array([1.0, 8.0, 0.1, -0.2])
    P0 = np.diag([4.0, 4.0, 0.04, 0.04])
    k = np.arange(steps + 1.0)[:, None]
    course = x0[:2] + k * x0[2:]
    x = np.concatenate([course, np.repeat(x0[None, 2:], steps + 1, axis=0)], axis=1)[:, None]
    ranges = []
    for turn in (0.0, 0.3):  # the observer's velocity changes by it at half the time

        def observer(t, turn=turn):
            return np.array([0.2 * t - turn * max(0.0, t - steps / 2), turn * max(0.0, t - 10)])

        found = posterior_bound(bearings(observer), x0, P0, k[:, 0], x).cov[-1]
        J = np.linalg.inv(P0)
        for t in range(1, steps + 1):
            dx, dy = course[t] - observer(t)
            h = np.array([dy, -dx, t * dy, -t * dx]) / (dx**2 + dy**2)
            J = J + np.outer(h, h) / SIGMA**2
        ahead = np.eye(4) + steps * np.diag([1.0, 1.0], 2)
        np.testing.assert_allclose(found, ahead @ np.linalg.inv(J) @ ahead.T, rtol=1e-5)
        relative = np.concatenate([x0[:2] - observer(0), x0[2:] - (observer(1) - observer(0))])
        inverse = np.linalg.inv(P0)
        ranges.append(relative @ (J - inverse) @ relative / (relative @ inverse @ relative))
    assert ranges[0] < 1e-9
    assert ranges[1] > 10


def test_a_falling_body_seen_from_aside():
    """The model of Athans, Wishner & Bertolini (1968), without noise of the process.

    The bound of a deterministic course is the inverse of the information of its start (Taylor 1979,
    IEEE Trans. Automatic Control 24(2)), here from derivatives by complex steps of whole courses.
    """
    model = FunctionModel(fall, distance, np.zeros((3, 3)), np.array([[NOISE**2]]))
    x = [MEAN[None] + 0j + 1e-30j * np.eye(3)]  # one row for each coordinate of the start
    for _ in range(STEPS):
        x.append(fall(x[-1], None, 0.0, 1.0))
    course = np.array(x)
    J, real = np.linalg.inv(PRIOR), course.real[:, :1]
    found = posterior_bound(model, MEAN, PRIOR, np.arange(STEPS + 1.0), real).cov
    for k in range(1, STEPS + 1):
        read = np.sqrt(ASIDE**2 + (course[k, :, 0] - ASIDE) ** 2)
        slope = read.imag / 1e-30
        J = J + np.outer(slope, slope) / NOISE**2
        along = course[k].imag.T / 1e-30
        expected = along @ np.linalg.inv(J) @ along.T
        np.testing.assert_allclose(found[k].diagonal(), expected.diagonal(), rtol=1e-4)


def test_stone_soups_bound_of_a_target_seen_by_two_radars():
    """`PCRBMetric` of Stone Soup along one course: Tichavský's recursion by matrix inverses.

    Nearly constant velocity with a regular Q, range and bearing from two places.
    """
    pytest.importorskip("stonesoup")
    from stonesoup.metricgenerator.pcrbmetric import PCRBMetric
    from stonesoup.models.measurement.nonlinear import CartesianToBearingRange
    from stonesoup.models.transition.linear import (
        CombinedLinearGaussianTransitionModel,
        ConstantVelocity,
    )
    from stonesoup.types.array import StateVector
    from stonesoup.types.groundtruth import GroundTruthPath, GroundTruthState
    from stonesoup.types.state import GaussianState

    density, R = 0.05, np.diag([0.02**2, 0.5**2])
    P0, steps = np.diag([5.0, 10.0, 5.0, 10.0]), 20
    places = np.array([[-10.0, 10.0], [25.0, -4.0]])
    x = np.stack([1.0 + 1.2 * np.arange(21), np.full(21, 1.2), 2.0 + 0.7 * np.arange(21),
                  np.full(21, 0.7)], axis=1)  # fmt: skip

    class Columns:
        """The places; a column of Stone Soup's own array is a vector, which its sensors refuse."""

        shape = places.T.shape

        def __getitem__(self, key):
            return StateVector(places[key[1]])

    began = datetime(2000, 1, 1)
    course = GroundTruthPath(
        [GroundTruthState(StateVector(xk), began + timedelta(seconds=k)) for k, xk in enumerate(x)]
    )
    theirs = PCRBMetric._compute_pcrb_single(
        GaussianState(StateVector(x[0]), P0),
        CombinedLinearGaussianTransitionModel([ConstantVelocity(density)] * 2),
        CartesianToBearingRange(ndim_state=4, mapping=(0, 2), noise_covar=R),
        course,
        Columns(),
        1.0,
        (0, 2),
        None,
    )

    def h(x, u, t):
        away = x[..., None, [0, 2]] - places
        bearing, distance = (
            np.arctan2(away[..., 1], away[..., 0]),
            np.hypot(*np.moveaxis(away, -1, 0)),
        )
        return np.stack([bearing, distance], axis=-1).reshape(*x.shape[:-1], 4)

    A, Q = np.array([[1.0, 1.0], [0.0, 1.0]]), density * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])
    F = np.kron(np.eye(2), A)
    model = FunctionModel(
        lambda x, u, t, dt: x @ F.T, h, np.kron(np.eye(2), Q), np.kron(np.eye(2), R)
    )
    found = posterior_bound(model, x[0], P0, np.arange(steps + 1.0), x[:, None])
    # Both take the derivatives of the bearing by differences, which agree to some 1e-7.
    np.testing.assert_allclose(found.cov, theirs["inverse_j"], rtol=1e-6, atol=1e-9)
