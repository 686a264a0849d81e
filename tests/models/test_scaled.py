import numpy as np
import pytest

from estbench.errors import ScenarioError
from estbench.models.protocol import Model
from estbench.models.scaled import ScaledNoise
from tests.helpers import linear_model, nonlinear_model


def test_scaled_noise_scales_the_noise_only():
    model = nonlinear_model(4)
    scaled = ScaledNoise(model, q=100.0, r=4.0)
    assert isinstance(scaled, Model)
    x, u = np.random.default_rng(0).standard_normal((2, 4)), np.ones((2, 1))
    np.testing.assert_allclose(scaled.process_noise(x, u, 0, 0.1), 100 * model.Q)
    np.testing.assert_allclose(scaled.measurement_noise(0.0), 4 * model.R)
    np.testing.assert_array_equal(scaled.transition(x, u, 0, 0.1), model.transition(x, u, 0, 0.1))
    for one, other in zip(
        (*scaled.transition_jacobian(x, u, 0, 0.1), *scaled.measurement_jacobian(x, u, 0)),
        (*model.transition_jacobian(x, u, 0, 0.1), *model.measurement_jacobian(x, u, 0)),
    ):
        np.testing.assert_array_equal(one, other)
    assert scaled.space is model.space
    assert scaled.nu == 1
    assert scaled.output().n == 3


@pytest.mark.parametrize("scales", [{"q": 0.0}, {"r": -1.0}, {"q": float("nan")}])
def test_scales_must_be_positive(scales):
    with pytest.raises(ScenarioError, match="use a positive number"):
        ScaledNoise(linear_model(0), **scales)
