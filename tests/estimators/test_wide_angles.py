"""Moments of angles under wide beliefs are those of the unwrapped line."""

import numpy as np
import pytest

from estbench.estimators.registry import create
from estbench.estimators.sigma_points import cubature, gauss_hermite, scaled
from estbench.models.function import FunctionModel
from estbench.spaces.manifold import Manifold

R, Q = 0.01, 1e-12
RULES = [("ghkf", {"order": order}) for order in (3, 4, 5, 10, 20)]
RULES += [("ckf", {}), ("ukf", {}), ("ukf", {"redraw": False}), ("sr_ukf", {}), ("iekf", {})]


def wrap(x):
    return np.arctan2(np.sin(x), np.cos(x))


def heading(n, function=lambda x: x):
    """n headings that stand still, each measured; `function` is applied to what f and h return."""
    return FunctionModel(
        f=lambda x, u, t, dt: function(x), h=lambda x, u, t: function(x), Q=Q * np.eye(n),
        R=R * np.eye(n), angles=range(n), state_angles=range(n),
    )  # fmt: skip


def kalman(start, std, y):
    """Posterior mean and variance on the line."""
    P = std**2 + Q
    return start + P / (P + R) * (y - start), P * R / (P + R)


def followed(name, settings, model, start, std, y):
    estimator, n = create(name, settings, model), model.space.n
    belief = estimator.init(np.full((2, n), start), np.tile(std**2 * np.eye(n), (2, 1, 1)))
    none = np.zeros((2, 0))
    belief, innovation = estimator.update(
        estimator.predict(belief, none, 0.0, 1.0), np.full((2, n), y), none, 1.0
    )
    return estimator.mean(belief), estimator.cov(belief), innovation


@pytest.mark.parametrize("start", [0.0, 3.0, -200.0])
@pytest.mark.parametrize("std", [0.1, 0.35, 0.6, 1.0, 1.5, 4.0])
@pytest.mark.parametrize(("name", "settings"), RULES)
def test_a_function_that_does_not_wrap_keeps_the_line_at_any_width(name, settings, std, start):
    mean, cov, innovation = followed(name, settings, heading(1), start, std, start + 0.3)
    expected, variance = kalman(start, std, start + 0.3)
    np.testing.assert_allclose(mean[:, 0], expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(cov[:, 0, 0], variance, rtol=1e-7)
    np.testing.assert_allclose(innovation.nis, 0.3**2 / (std**2 + Q + R), rtol=1e-6)


@pytest.mark.parametrize("std", [0.5, 0.9, 2.0])
@pytest.mark.parametrize("name", ["ckf", "ukf", "sr_ukf"])
def test_twelve_headings(name, std):
    mean, cov, _ = followed(name, {}, heading(12), 3.0, std, 3.3)
    expected, variance = kalman(3.0, std, 3.3)
    np.testing.assert_allclose(mean, expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(cov, np.broadcast_to(variance * np.eye(12), cov.shape), atol=1e-9)


@pytest.mark.parametrize("start", [0.0, 3.0])
@pytest.mark.parametrize(
    ("name", "settings", "std"),
    [
        ("ghkf", {"order": 3}, 1.0), ("ghkf", {"order": 3}, 1.7), ("ghkf", {"order": 4}, 1.2),
        ("ghkf", {"order": 5}, 1.0), ("ghkf", {"order": 10}, 0.6), ("ghkf", {"order": 20}, 0.4),
        ("ckf", {}, 1.5), ("ukf", {}, 3.0), ("sr_ukf", {}, 3.0),
    ],
)  # fmt: skip
def test_a_function_that_wraps_is_exact_while_the_points_are_within_half_a_turn(
    name, settings, std, start
):
    mean, cov, _ = followed(name, settings, heading(1, wrap), start, std, start + 0.3)
    expected, variance = kalman(start, std, start + 0.3)
    np.testing.assert_allclose(wrap(mean[:, 0] - expected), 0.0, atol=1e-9)
    np.testing.assert_allclose(cov[:, 0, 0], variance, rtol=1e-7)


@pytest.mark.parametrize(
    "rule", [gauss_hermite(2, 5), gauss_hermite(2, 6), cubature(2), scaled(2, 1e-2)]
)
def test_moments_of_a_bent_angle_are_those_of_the_line(rule):
    # A bearing error that grows with its square: not symmetric about the centre.
    points = rule.points * 0.5 + [3.0, 0.0]
    bent = points + 0.2 * (points - [3.0, 0.0]) ** 2
    circle, line = Manifold.euclidean(2, angles=[0]), Manifold.euclidean(2)
    turned = np.stack([wrap(bent[:, 0]), bent[:, 1]], axis=-1)[None]
    for found, expected in zip(rule.moments(circle, turned), rule.moments(line, bent[None])):
        difference = found - expected
        difference[..., 0] = wrap(difference[..., 0])
        np.testing.assert_allclose(difference, 0.0, atol=1e-9)


@pytest.mark.parametrize("std", [0.3, 0.7, 1.2])
@pytest.mark.parametrize("start", [0.0, 3.0])
@pytest.mark.parametrize("name", ["pf", "enkf"])
def test_particles_anywhere(name, std, start):
    """Within 5 standard errors: a false alarm in 6e-7 of the cases, of which there are 12."""
    size = 4000
    model = heading(1, wrap)
    estimator = create(name, {"size": size}, model)
    belief = estimator.init(np.full((1, 1), start), np.full((1, 1, 1), std**2))
    # The 0.9% of the points that are beyond half a turn come back on the other side.
    error = wrap(estimator.mean(belief) - start)
    assert abs(error[0, 0]) < 5 * std / np.sqrt(size)
    assert np.sqrt(estimator.cov(belief)[0, 0, 0]) == pytest.approx(std, rel=0.08)
