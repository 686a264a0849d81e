"""Sobol indices: those of the Ishigami function, through scenario, study, runs and statistics."""

from dataclasses import dataclass

import numpy as np
import pytest

import estbench
from estbench.errors import StudyError
from estbench.estimators.beliefs import Gaussian
from estbench.estimators.protocol import Innovation
from estbench.sensitivities.indices import indices
from estbench.sensitivities.parameter import Parameter
from estbench.study.axes import Range

ROBOT = """
<mujoco><option timestep="0.01" gravity="0 0 0"/>
  <worldbody><body><joint name="x" type="slide" axis="1 0 0"/><geom size="0.1" mass="1"/></body>
  </worldbody><sensor><jointpos name="p" joint="x" noise="0.1"/></sensor></mujoco>"""
SCENARIO = """
name = "still"
[model]
path = "still.xml"
[initial]
std = 0.0
[process_noise]
density = 0.0
[simulation]
duration = 0.02
runs = 2
[consistency]
divergence_threshold = 1e15
[estimators.ishigami]
type = "tests.sensitivities.test_indices:Ishigami"
a = 0.5
b = 0.5
c = 0.5
"""


def ishigami(a, b, c):
    return np.sin(a) + 7 * np.sin(b) ** 2 + 0.1 * c**4 * np.sin(a)


class Ishigami:
    """An estimator that is wrong by exp f(a, b, c)/2, f of Ishigami and Homma (1990).

    Of a robot at rest its log RMSE is f/2.
    """

    def __init__(self, model, a: float, b: float, c: float):
        self.error = np.exp(ishigami(a, b, c) / 2)

    def init(self, mean, cov):
        wide = np.broadcast_to(np.eye(2), cov.shape)
        return Gaussian(mean + self.error, wide, np.zeros(len(mean), np.uint8))

    def predict(self, belief, u, t, dt):
        return belief

    def update(self, belief, y, u, t, channels=None, mask=None):
        runs, m = y.shape
        nothing, S = np.zeros((runs, m)), np.broadcast_to(np.eye(m), (runs, m, m))
        return belief, Innovation(nothing, S, nothing, np.zeros(runs), np.full(runs, m))

    def mean(self, belief):
        return belief.mean

    def cov(self, belief):
        return belief.cov


@dataclass
class Given:
    """An outcome with an RMSE."""

    record: dict
    reason: str = ""


def directly(points):
    """The outcomes of the function itself."""
    out = []
    for point in points:
        mse = np.exp(ishigami(*point.values()))
        record = {"diverged": np.zeros(2), "mse": np.full((2, 2), mse), "anees": np.full(2, mse)}
        out.append(Given(record))
    return out


PARAMETERS = [
    Parameter(
        name, ("estimators", "ishigami", name), "filter", 0.5, given=Range(-np.pi, np.pi, False)
    )
    for name in "abc"
]


def test_the_ishigami_function():
    """First-order and total indices; 0.02: more than the largest error of this design."""
    found = indices(PARAMETERS, directly, 1024, 2.0, 0, 0.95)
    for k in range(2):  # log NEES/n is f, log RMSE is f/2
        np.testing.assert_allclose(found.first[k, :, 0], [0.3139, 0.4424, 0.0], atol=0.02)
        np.testing.assert_allclose(found.total[k, :, 0], [0.5576, 0.4424, 0.2437], atol=0.02)
    np.testing.assert_allclose(found.std, [0.5 * 3.7208, 3.7208], rtol=0.01)
    assert (found.first[..., 1] < found.first[..., 0]).all()
    assert (found.total[..., 2] > found.total[..., 0]).all()
    assert found.points == 1024 * 5


def test_the_study_gives_the_indices_of_what_its_runs_give(tmp_path):
    """Scenario, study, runs and statistics give the function itself, to the last digits."""
    (tmp_path / "still.xml").write_text(ROBOT)
    (tmp_path / "still.toml").write_text(SCENARIO)
    keys = [f"estimators.ishigami.{name}=lin:{-np.pi}:{np.pi}" for name in "abc"]
    found = estbench.sensitivity(tmp_path / "still.toml", key=keys, sobol=8, workers=1)
    same = indices(PARAMETERS, directly, 8, 2.0, 0, 0.95)
    assert [p.key[-1] for p in found.indices.parameters] == ["a", "b", "c"]
    np.testing.assert_allclose(found.indices.first, same.first, rtol=1e-6)
    np.testing.assert_allclose(found.indices.total, same.total, rtol=1e-6)
    np.testing.assert_allclose(found.indices.std, same.std, rtol=1e-9)
    assert found.dataset().total.dims == ("output", "indexed")


def test_wrong_requests(tmp_path):
    with pytest.raises(StudyError, match="use a power of two"):
        estbench.sensitivity("pendulum", runs=2, sobol=12)
    with pytest.raises(StudyError, match="at least two parameters"):
        estbench.sensitivity("pendulum", runs=2, key=["start.inflate"], sobol=8)
    with pytest.raises(StudyError, match="use a factor above 1"):
        estbench.sensitivity("pendulum", runs=2, sobol=8, spread=0.5)
