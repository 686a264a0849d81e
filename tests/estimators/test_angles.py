"""A radar whose bearing crosses ± π: no filter may know where the circle was cut."""

import numpy as np
import pytest

from estbench.errors import DimensionError, EstimatorError
from estbench.estimators.beliefs import Gaussian
from estbench.estimators.protocol import Measurement
from estbench.estimators.registry import create
from estbench.models.function import FunctionModel
from estbench.smoothers.map import map_estimate
from tests.helpers import EXACT

DT, STEPS, RUNS = 1.0, 12, 3
F = np.eye(4) + DT * np.eye(4, k=2)
NONE = np.zeros((RUNS, 0))


def polar(x, u, t):
    return np.stack([np.hypot(x[..., 0], x[..., 1]), np.arctan2(x[..., 1], x[..., 0])], axis=-1)


def radar(angles=(1,)):
    return FunctionModel(
        f=lambda x, u, t, dt: (F @ x[..., None])[..., 0], h=polar, Q=1e-3 * np.diag([1, 1, 4, 4]),
        R=np.diag([0.1, 0.01]) ** 2, angles=angles,
    )  # fmt: skip


def passing(side):
    """States, and readings in [-π, π], of a target that passes on one side of the radar."""
    rng = np.random.default_rng(3)
    x = np.empty((STEPS + 1, RUNS, 4))
    x[0] = [10.0, -4.0, 0.1, 0.7] + rng.standard_normal((RUNS, 4)) * [0.3, 0.3, 0.05, 0.05]
    for k in range(STEPS):
        x[k + 1] = x[k] @ F.T
    noise = rng.standard_normal((STEPS, RUNS, 2)) * [0.1, 0.01]
    bearing = polar(side * x[1:], None, 0.0) + noise
    bearing[..., 1] = np.arctan2(np.sin(bearing[..., 1]), np.cos(bearing[..., 1]))
    start = side * (x[0] + rng.standard_normal((RUNS, 4)) * 0.1)
    return side * x, bearing, start


def followed(estimator, start, readings):
    belief = estimator.init(start, np.tile(0.1 * np.eye(4), (RUNS, 1, 1)))
    out = []
    for k, y in enumerate(readings):
        belief, innovation = estimator.update(
            estimator.predict(belief, NONE, k * DT, DT), y, NONE, (k + 1) * DT
        )
        out.append((estimator.mean(belief), estimator.cov(belief), innovation.nis))
    return [np.array(part) for part in zip(*out)]


@pytest.mark.parametrize("name", [*EXACT, "robust_ekf", "adaptive_ekf", "bias_ekf", "schmidt_ekf"])
def test_the_posterior_turns_with_the_scene(name):
    settings = {"bias_ekf": {"bias": {"y1": 0.01}}}.get(name, {})
    _, ahead, start = passing(1)
    _, behind, turned = passing(-1)
    assert np.abs(np.diff(behind[..., 1], axis=0)).max() > 6  # it does cross
    a = followed(create(name, settings, radar()), start, ahead)
    b = followed(create(name, settings, radar()), turned, behind)
    np.testing.assert_allclose(b[0], -a[0], atol=1e-6)
    np.testing.assert_allclose(b[1], a[1], atol=1e-6)
    np.testing.assert_allclose(b[2], a[2], rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("name", ["enkf", "pf"])
def test_random_filters_follow_through_the_cut(name):
    truth, behind, start = passing(-1)
    mean, _, _ = followed(create(name, {"size": 2000}, radar()), start, behind)
    assert np.abs(mean[3:] - truth[4:])[..., :2].max() < 1.0
    lost, _, _ = followed(create("ekf", {}, radar(())), start, behind)
    assert np.abs(lost[3:] - truth[4:])[..., :2].max() > 1.0  # without `angles`


def test_the_map_smoother_looks_back_through_the_cut():
    truth, behind, start = passing(-1)
    cov = np.tile(0.1 * np.eye(4), (RUNS, 1, 1))
    prior = Gaussian(start, cov, np.zeros(RUNS, np.uint8))
    times = [k * DT for k in range(STEPS + 1)]
    readings = [[], *([Measurement(y, NONE)] for y in behind)]
    found = map_estimate(radar(), prior, [NONE] * STEPS, times, readings)
    mean = np.array([belief.mean for belief in found.beliefs])
    assert np.abs(mean - truth)[..., :2].max() < 1.0


def test_angles_that_do_not_fit():
    with pytest.raises(DimensionError, match=r"angles is \[2\]; use some of 0 to 1"):
        radar([2])
    with pytest.raises(EstimatorError, match="holds a quaternion or an angle"):
        create("filterpy_ukf", {}, radar())
