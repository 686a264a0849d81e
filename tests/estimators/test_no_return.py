"""Filters whose predicted reading has no return: at the mean, at some points, at all."""

import numpy as np
import pytest

from estbench.estimators import registry
from estbench.estimators.no_return import extended
from estbench.estimators.protocol import Estimator
from estbench.models.function import FunctionModel
from estbench.spaces.linalg import quiet
from estbench.spaces.manifold import Manifold

A = np.array([[1.0, 0.1], [0.0, 1.0]])
EVERYONE = ["kf", "lkf", "ekf", "sr_ekf", "iekf", "ukf", "sr_ukf", "ckf", "ghkf", "enkf", "pf",
            "robust_ekf", "adaptive_ekf", "schmidt_ekf", "bias_ekf", "imm", "iplf",
            "rotated_ukf"]  # fmt: skip


def model(edge: float) -> FunctionModel:
    """Position and, up to an edge, a range to it; beyond the edge the range has no return."""

    def h(x: np.ndarray, u: np.ndarray, t: float) -> np.ndarray:
        far = np.where(x[..., 0] < edge, 3.0 - x[..., 0], np.inf)
        return np.stack([x[..., 0], far], axis=-1)

    return FunctionModel(
        lambda x, u, t, dt: x @ A.T, h, np.diag([1e-4, 1e-2]), np.diag([0.04, 0.01]),
    )  # fmt: skip


def updated(name: str, edge: float, y: list[float], mask: list[bool] | None):
    """The belief of a new estimator after one prediction and one update."""
    estimator = registry.create(name, {}, model(edge))
    assert isinstance(estimator, Estimator)
    belief = estimator.init(np.zeros((1, 2)), 0.09 * np.eye(2)[None])
    belief = estimator.predict(belief, np.zeros((1, 0)), 0.0, 1.0)
    given = {} if mask is None else {"mask": np.array([mask])}
    with quiet():
        belief, innovation = estimator.update(
            belief, np.array([y]), np.zeros((1, 0)), 1.0, None, **given
        )
    return estimator.mean(belief), estimator.cov(belief), innovation


@pytest.mark.parametrize("name", EVERYONE)
def test_a_predicted_no_return_is_a_component_that_did_not_arrive(name: str) -> None:
    """Mean, P, NIS and degrees of freedom are those of the other component alone."""
    mean, cov, innovation = updated(name, -9.0, [0.2, 2.7], None)
    expected_mean, expected_cov, expected = updated(name, -9.0, [0.2, 0.0], [True, False])
    assert innovation.dof.tolist() == [1]
    np.testing.assert_allclose(mean, expected_mean, rtol=0, atol=1e-12)
    np.testing.assert_allclose(cov, expected_cov, rtol=0, atol=1e-12)
    np.testing.assert_allclose(innovation.nis, expected.nis, rtol=1e-12)
    assert innovation.white[0, 1] == 0.0


@pytest.mark.parametrize("name", ["ukf", "sr_ukf", "ghkf", "ckf"])
def test_points_beyond_the_edge_see_the_surface_go_on(name: str) -> None:
    """One point of the rule has no return: a reading that is linear is extended exactly."""
    near, far = updated(name, 0.2, [0.1, 2.9], None), updated(name, 99.0, [0.1, 2.9], None)
    assert near[2].dof.tolist() == [2]
    for found, expected in zip(near[:2], far[:2]):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10)
    np.testing.assert_allclose(near[2].nis, far[2].nis, rtol=1e-10)


def test_a_run_without_a_return_changes_no_other() -> None:
    """Points of three runs: all with a return, most, few; each is done for itself."""
    space, output = Manifold.euclidean(2), Manifold.euclidean(1)
    points = np.random.default_rng(0).standard_normal((3, 40, 2))
    images = 1.0 + points @ np.array([[2.0], [-1.0]])
    expected = images.copy()
    gone = np.stack([np.zeros(40, bool), points[1, :, 0] > 1.0, points[2, :, 0] > -1.0])
    images[gone] = np.inf
    out, mask = extended(space, output, points, images, None)
    assert mask is not None
    assert mask.tolist() == [[True], [True], [False]]
    np.testing.assert_allclose(out[:2], expected[:2], rtol=0, atol=1e-12)
    assert np.isfinite(out).all()


def test_points_that_do_not_span_those_without_a_return_are_not_extended() -> None:
    """Both points along one axis are gone: the slope there is unknown, the component is masked."""
    space, output = Manifold.euclidean(2), Manifold.euclidean(1)
    points = np.concatenate([np.zeros((1, 2)), np.eye(2), -np.eye(2)])[None]
    images = points[..., :1].copy()
    images[0, [1, 3]] = np.inf
    _, mask = extended(space, output, points, images, None)
    assert mask is not None
    assert not mask.any()
    flat = points * [0.0, 1.0]  # no point differs along the first axis: nothing is unknown
    images = np.where(np.isinf(images), np.inf, 5.0)
    out, mask = extended(space, output, flat, images, None)
    assert mask is not None
    assert mask.all()
    assert (out == 5.0).all()


def test_a_dead_particle_has_no_weight() -> None:
    """A point that is NaN stays NaN and does not change the plane."""
    space, output = Manifold.euclidean(1), Manifold.euclidean(1)
    points = np.arange(5.0).reshape(1, 5, 1)
    points[0, 1] = np.nan
    images = 2.0 * points
    images[0, 4] = np.inf
    out, mask = extended(space, output, points, images, None)
    assert mask is not None
    assert mask.all()
    np.testing.assert_allclose(out[0, [0, 2, 3, 4], 0], [0.0, 4.0, 6.0, 8.0], atol=1e-12)
    assert np.isnan(out[0, 1, 0])
