"""Elasticities against a Riccati equation, ranges, and what is varied.

Intervals are at 99.99%, and the seeds are fixed: nothing is random from one test to the next. With
other random numbers one of the 7 comparisons would fail with a probability of 0.07%.
"""

import numpy as np
import pytest
import xarray as xr

import estbench
from estbench.budgets.budget import one
from estbench.consistency.verdict import Verdict
from estbench.errors import StudyError
from estbench.experiment.setup import build
from estbench.scenario.load import resolve
from estbench.sensitivities.choice import chosen
from estbench.sensitivities.discovery import parameters
from estbench.sensitivities.elasticity import elasticity
from estbench.sensitivities.parameter import Parameter
from estbench.sensitivities.points import computed
from estbench.sensitivities.ranges import check, ranges
from estbench.sensitivities.sensitivity import of_scenario

H, M, D, Q, R = 0.01, 1.0, 4.0, 0.5, 0.1
CART = f"""
<mujoco>
  <option timestep="{H}" gravity="0 0 0"/>
  <worldbody><body name="cart"><joint name="x" type="slide" axis="1 0 0" damping="{D}"/>
    <geom size="0.1" mass="{M}"/></body></worldbody>
  <sensor><jointvel name="v" joint="x" noise="{R}"/></sensor>
</mujoco>"""
SCENARIO = f"""
name = "cart"
[model]
path = "cart.xml"
[initial]
std = {{ "x" = 0.0, "x.vel" = 0.1 }}
[process_noise]
density = {{ "x.vel" = {Q} }}
[simulation]
duration = 0.6
runs = 40
[consistency]
burn_in = 0.2
level = 0.9999
[estimators.ekf]
"""


def riccati(own, belief):
    """Stationary variance of the velocity's error, of the filter that believes other numbers.

    v⁺ = a v + w, a = 1/(1 + h d/m) (implicit damping), y = v + ν; the variances are those after
    updates. (own, belief) are (a, Q, R) of the truth and of the filter.
    """
    (a, q, r), (af, qf, rf) = own, belief
    p = 1.0
    for _ in range(2000):
        prior = af * af * p + qf
        k = prior / (prior + rf)
        p = (1 - k) * prior
    assert a == af  # else the error would depend on the velocity
    return ((1 - k) ** 2 * q + k * k * r) / (1 - (1 - k) ** 2 * a * a), p


def slope(f, x, step=1e-4):
    return np.log(f(x * (1 + step)) / f(x / (1 + step))) / (2 * np.log1p(step))


def test_elasticities_are_those_of_the_scalar_riccati_equation(tmp_path):
    (tmp_path / "cart.xml").write_text(CART)
    (tmp_path / "cart.toml").write_text(SCENARIO)
    keys = ("*channels.v.noise", "*process_noise*", "model.set.dof_damping.x")
    found = estbench.sensitivity(tmp_path / "cart.toml", "ekf", key=keys, workers=1)
    rmse = {s.parameter.key: s.each[1] for s in found.slopes}

    def a(d):
        return 1 / (1 + H * d / M)

    # w has the density Q over the step, and enters before the damping of the step or after it.
    def sigma(d=D, q=Q, r=R, qf=None, rf=None):
        own = (a(d), q * H, r * r)
        other = (a(d), (q if qf is None else qf) * H, (r if rf is None else rf) ** 2)
        return np.sqrt(riccati(own, other)[0])

    expected = {
        "channels.v.noise": slope(lambda x: sigma(r=x), R),
        "process_noise.density": slope(lambda x: sigma(q=x), Q),
        "model.set.dof_damping.x": slope(lambda x: sigma(d=x), D),
        "filter.channels.v.noise": slope(lambda x: sigma(rf=x), R),
        "filter.process_noise_scale": slope(lambda x: sigma(qf=x * Q), 1.0),
    }
    assert rmse.keys() == expected.keys()
    assert expected["channels.v.noise"] > 0.4
    assert abs(expected["filter.channels.v.noise"]) < 1e-3  # the optimum
    for key, value in expected.items():
        assert value in rmse[key], key
        assert rmse[key].high - rmse[key].low < 0.2, key
    # The filter's own variance, without noise: NEES of the velocity alone has this slope.
    both = slope(lambda x: riccati((a(D), Q * H, R * R), (a(D), Q * H, x * x))[1], R)
    nees = {s.parameter.key: s.nees for s in found.slopes}
    assert nees["filter.channels.v.noise"].value < 0 < both
    data = found.dataset()
    assert data.coordinate_rmse.dims == ("parameter", "coordinate")


def test_an_elasticity_and_its_interval():
    """Of y = θ² z with the same z at both values: 2, and no width; of others the spread counts."""
    z = np.random.default_rng(0).gamma(2.0, size=(50, 3))
    found = elasticity(4.0 * z, 9.0 * z, 1.5, 0.95)
    assert found.value == pytest.approx(2.0)
    assert found.high - found.low < 1e-9
    other = np.random.default_rng(1).gamma(2.0, size=(50, 3))
    apart = elasticity(z, other, 1.5, 0.95)
    assert 0 in apart
    assert apart.high - apart.low > 0.5
    assert np.isnan(elasticity(z[:0], z[:0], 1.5, 0.95).value)


def test_what_is_varied_and_by_how_much():
    scenario = one(resolve("cartpole_bias", ["bias_ekf"]))
    setup = build(scenario)
    found = {p.key: p for p in parameters(setup, "bias_ekf")}
    assert {
        "filter.channels.gyro.noise", "filter.process_noise_scale", "start.inflate",
        "filter.set.dof_damping.pole", "filter.timestep", "estimators.bias_ekf.walk.gyro.y",
        "channels.gyro.bias_walk", "channels.accel.rate", "initial.std", "model.set.body_mass.cart",
        "model.timestep", "process_noise.density",
    } <= found.keys()  # fmt: skip
    assert not {"channels.gyro.drift", "channels.gyro.latency"} & found.keys()  # they are zero
    assert found["channels.gyro.bias"].changes(2.0) == {("channels", "gyro", "bias"): 0.04}
    rate = found["channels.accel.rate"]
    assert rate.neighbours(1.1) == (0.5, 1.0)  # it cannot be read more often
    assert rate.changes(0.5) == {("channels", "accel", "rate"): 50.0}
    step = found["model.timestep"].changes(0.5)
    assert step == {("model", "timestep"): 0.005, ("model", "frame_skip"): 2}
    finer = {p.key for p in parameters(setup, "bias_ekf", by_source=True)}
    assert {"initial.std.pole", "filter.process_noise.density.pole.vel"} <= finer
    (one_,) = chosen(tuple(found.values()), ["filter.channels.g*=log:0.01:0.1"], scenario)
    assert one_.at(0.0) == {("estimators", "bias_ekf", "filter", "channels", "gyro", "noise"): 0.01}
    late = Parameter("l", ("l",), "hardware", 0.03, "s", "latency", 0.01)
    assert late.neighbours(1.1) == pytest.approx((2 / 3, 4 / 3))


def test_beliefs_share_the_truth_and_a_failure_is_named():
    scenario = one(resolve("pendulum", ["ekf"], runs=4, duration=0.1, overrides=["bound=false"]))
    noise = ("estimators", "ekf", "filter", "channels", "gyro", "noise")
    mass = ("model", "set", "body_mass.arm")
    own, belief, bad, heavy = computed(scenario, [{}, {noise: 0.1}, {mass: -1.0}, {mass: 0.7}], 4)
    assert "cannot be negative" in bad.reason
    assert bad.record is None
    assert own.record is not None
    assert belief.record is not None
    assert heavy.record is not None
    assert (own.record["mse"] != belief.record["mse"]).any()
    alone = estbench.run(scenario, overrides=["estimators.ekf.filter.channels.gyro.noise=0.1"])
    np.testing.assert_array_equal(alone.records["ekf"]["mse"], belief.record["mse"])


class Judged:
    """An outcome with a verdict alone."""

    def __init__(self, verdict, nees=1.0):
        self.reason, self.verdict = "", verdict
        ones = np.ones((2, 1))
        self.record = {"diverged": np.zeros(2), "mse": ones, "anees": np.full(2, nees)}

    @property
    def summary(self):
        return type("Summary", (), {"verdict": self.verdict, "reason": "why"})


def within(low, high):
    """What consistency within a range would give."""

    def evaluate(points):
        values = [point.get(("x",), 1.0) for point in points]
        return [
            Judged(Verdict.CONSISTENT if low <= v <= high else Verdict.BIASED, v) for v in values
        ]

    return evaluate


def test_ranges_are_found_and_moved_to_where_other_runs_confirm_them():
    x = Parameter("x", ("x",), "filter", 1.0)
    ((low, high),) = ranges([x], within(0.6, 100.0), within(0.5, 100.0))
    assert 0.6 <= low.factor < 0.6 * 1.03
    assert low.beyond < 0.6
    assert low.confirmed
    assert low.verdict == Verdict.BIASED
    assert (high.factor, high.beyond) == (10.0, None)  # the reach of the search
    ((_, high),) = ranges([x], within(0.1, 3.0), within(0.1, 2.0))
    assert 1.0 < high.factor <= 2.0 < high.beyond
    assert high.confirmed
    with pytest.raises(StudyError, match="the verdict is biased as the scenario is"):
        check(*within(2.0, 3.0)([{}]))


def test_the_range_of_a_pendulum():
    """With a tolerance of 1/2 few runs show how well R of the gyro must be known."""
    few = {"runs": 40, "duration": 0.2, "overrides": ["consistency.tolerance=0.5"]}
    scenario = one(resolve("pendulum", ["ekf"], **few))
    found = of_scenario(scenario, key=["filter.channels.gyro.noise"], ranges=True)
    ((_, low, high),) = found.ranges
    assert 0.5 < low.factor < 1.0 < high.factor
    assert low.confirmed
    assert low.beyond == pytest.approx(low.factor, rel=0.3)
    data = found.dataset()
    assert isinstance(data, xr.Dataset)
    assert data.range_low.item() == low.factor
