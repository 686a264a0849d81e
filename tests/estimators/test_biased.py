import numpy as np
import pytest

from estbench.errors import EstimatorError
from estbench.estimators.beliefs import Fault
from estbench.estimators.biased import BiasEKF, BiasUKF
from estbench.estimators.ekf import EKF
from estbench.estimators.registry import create
from estbench.estimators.rotated_ukf import RotatedUKF
from estbench.estimators.schmidt import SchmidtEKF
from estbench.estimators.ukf import UKF
from estbench.models.augmented import Augmented
from estbench.models.linear import LinearModel
from tests.estimators.test_enkf import start
from tests.helpers import linear_model, mujoco_model, nonlinear_model, random_states


def biased_rotated(model, **settings):
    return BiasUKF(model, base="rotated_ukf", **settings)


PAIRS = [(BiasEKF, EKF), (BiasUKF, UKF), (biased_rotated, RotatedUKF)]


@pytest.mark.parametrize(("biased", "base"), PAIRS)
def test_without_biases_it_is_the_base_filter(biased, base):
    model = nonlinear_model(4)
    mean, cov, u = start(model, 3)
    a, b = biased(model), base(model)
    one, other = (f.predict(f.init(mean, cov), u, 0.0, 0.1) for f in (a, b))
    y = model.measurement(mean, u, 0.0)
    one, other = a.update(one, y, u, 0.1)[0], b.update(other, y, u, 0.1)[0]
    np.testing.assert_allclose(a.mean(one), b.mean(other), rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(a.cov(one), b.cov(other), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(("biased", "base"), PAIRS)
def test_it_is_the_base_filter_on_the_augmented_model(biased, base):
    model = linear_model(2)
    mean, cov, u = start(model, 3)
    filter = biased(model, bias={"y0": 0.5}, walk=0.1, inputs=0.3)
    augmented = Augmented.build(model, {"y0": 0.5}, walk=0.1, inputs=0.3)
    reference = base(augmented)
    a, b = filter.init(mean, cov), reference.init(*augmented.augment(mean, cov))
    for k in range(4):
        y = model.measurement(mean, u) + k
        a, b = filter.predict(a, u, k, 1.0), reference.predict(b, u, k, 1.0)
        (a, one), (b, other) = filter.update(a, y, u, k), reference.update(b, y, u, k)
        np.testing.assert_array_equal(one.nis, other.nis)
    np.testing.assert_array_equal(filter.mean(a), b.mean[:, :3])
    np.testing.assert_array_equal(filter.cov(a), b.cov[:, :3, :3])
    found = filter.biases(a)
    assert list(found) == ["bias.y0", "input.u0"]
    np.testing.assert_array_equal(found["input.u0"][0], b.mean[:, 4])
    np.testing.assert_allclose(found["bias.y0"][1], np.sqrt(b.cov[:, 3, 3]))


@pytest.mark.parametrize("biased", [BiasEKF, BiasUKF])
def test_finds_an_observable_bias(biased):
    """Two sensors of one position; only the second is biased."""
    dt, rng = 0.1, np.random.default_rng(0)
    model = LinearModel(
        np.array([[1, dt], [0, 1]]), np.array([[1.0, 0], [1.0, 0]]),
        1e-3 * np.diag([0, dt]), 0.01 * np.eye(2),
    )  # fmt: skip
    runs = 300
    u, x = np.empty((runs, 0)), rng.standard_normal((runs, 2))
    bias = 0.5 * rng.standard_normal((runs, 1))
    filter = biased(model, bias={"y1": 0.5})
    belief = filter.init(np.zeros((runs, 2)), np.tile(np.eye(2), (runs, 1, 1)))
    for k in range(60):
        x = x @ model.A.T
        x[:, 1] += np.sqrt(1e-3 * dt) * rng.standard_normal(runs)
        y = x[:, :1] + 0.1 * rng.standard_normal((runs, 2))
        y[:, 1:] += bias
        belief = filter.predict(belief, u, k * dt, dt)
        belief, _ = filter.update(belief, y, u, k * dt)
    estimate, std = filter.biases(belief)["bias.y1"]
    assert std.max() < 0.03
    assert abs(((estimate - bias[:, 0]) ** 2 / std**2).mean() - 1) < 4 * np.sqrt(2 / runs)
    error = filter.mean(belief) - x
    nees = np.einsum("ri,rij,rj->r", error, np.linalg.inv(filter.cov(belief)), error) / 2
    assert abs(nees.mean() - 1) < 4 / np.sqrt(runs)


def test_considered_biases_make_a_schmidt_filter():
    model = linear_model(2)
    mean, cov, u = start(model, 3)
    filter = BiasEKF(model, bias=0.5, considered=["bias.*"])
    augmented = Augmented.build(model, 0.5)
    reference = SchmidtEKF(augmented, considered=["bias.*"])
    y = model.measurement(mean, u) + 1
    a, _ = filter.update(filter.init(mean, cov), y, u, 0.0)
    b, _ = reference.update(reference.init(*augmented.augment(mean, cov)), y, u, 0.0)
    np.testing.assert_array_equal(filter.mean(a), b.mean[:, :3])
    np.testing.assert_array_equal(filter.biases(a)["bias.y0"][0], 0)


@pytest.mark.parametrize("biased", [BiasEKF, BiasUKF])
def test_masks_and_failed_runs(biased):
    model = linear_model(3)
    mean, cov, u = start(model, 3)
    mean[1] = np.nan
    filter = biased(model, bias=0.5)
    belief = filter.init(mean, cov)
    y = model.measurement(mean, u) + 0.5
    mask = np.array([[False, False], [True, True], [True, False]])
    posterior, innovation = filter.update(belief, np.where(mask, y, np.nan), u, 0.0, mask=mask)
    np.testing.assert_array_equal(innovation.dof, [0, 2, 1])
    np.testing.assert_array_equal(posterior.fault, [0, Fault.STATE, 0])
    np.testing.assert_allclose(filter.mean(posterior)[0], mean[0], rtol=1e-10, atol=1e-15)
    np.testing.assert_allclose(filter.cov(posterior)[0], cov[0], rtol=1e-10, atol=1e-14)
    assert filter.biases(posterior)["bias.y0"][0][2] != 0


@pytest.mark.parametrize("biased", [BiasEKF, BiasUKF])
def test_on_a_robot_by_name(biased):
    model = mujoco_model("joints", density=1e-3)
    x, u = random_states(model.mjmodel, 2)
    n = model.space.n
    filter = biased(model, bias={"gyro.*": 0.1, "wrist_quat*": 0.05}, walk={"gyro.*": 0.01})
    belief = filter.init(x, np.broadcast_to(1e-3 * np.eye(n), (2, n, n)))
    belief = filter.predict(belief, u, 0.0, 0.004)
    belief, _ = filter.update(belief, model.measurement(x, u, 0.0, ("gyro",)), u, 0.0, ("gyro",))
    assert filter.mean(belief).shape == (2, model.space.nx)
    assert filter.cov(belief).shape == (2, n, n)
    assert len(filter.biases(belief)) == 6
    assert not belief.fault.any()


def test_base_settings_reach_the_base_filter():
    name = "estbench.estimators.biased:BiasUKF"
    filter = create("b", {"type": name, "bias": 0.1, "settings": {"alpha": 0.5}}, linear_model(0))
    assert filter._filter.alpha == 0.5  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"bias": -0.1}, "BiasEKF: bias of y0: std is -0.1; use a number of at least 0"),
        ({"bias": {"gyro": 1}}, "BiasEKF: bias: 'gyro' matches none"),
        ({"bias": 1, "walk": 1, "time_constant": 1}, "BiasEKF: .* give one of them"),
        ({"considered": ["bias.*"]}, "BiasEKF: SchmidtEKF: considered: 'bias.*' matches none"),
        ({"settings": {"alpha": 1}}, "no setting 'alpha'"),
    ],
)
def test_wrong_settings_say_so(settings, words):
    with pytest.raises(EstimatorError, match=words):
        BiasEKF(linear_model(0), **settings)
