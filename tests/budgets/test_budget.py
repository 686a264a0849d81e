"""Linear and sampled budgets of scenarios: what they add up to, and that they agree."""

from dataclasses import replace

import numpy as np
import pytest

import estbench
from estbench.budgets.linear import linear
from estbench.budgets.montecarlo import ALL, sampled
from estbench.budgets.sources import CONDITIONS, sources
from estbench.budgets.switches import without
from estbench.consistency.intervals import positive_mean_interval
from estbench.experiment import recording
from estbench.experiment.setup import build
from estbench.scenario.load import resolve

LINEAR = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody><body><joint name="x" type="slide" axis="1 0 0"/><geom size="0.1" mass="1"/>
    <body><joint name="y" type="slide" axis="1 0 0" stiffness="2" damping="0.3"/>
      <geom size="0.1" mass="0.5"/></body></body></worldbody>
  <sensor><jointpos name="p" joint="x"/><jointvel name="v" joint="y"/></sensor>
</mujoco>"""


def setup(name, label, *overrides, **options):
    return build(resolve(name, [label], overrides=overrides, **options))


def agree(prepared, label, level=0.9999):
    """Each source alone, and all together: the linear figure is in the interval of the runs.

    Of contributions of more than 1%, and for a wrong parameter to 8%: the noises, which are not
    there when it is alone, move the truth along which it acts. The seeds are fixed, so that nothing
    is random from one test to the next; with other random numbers one of 100 comparisons would fail
    with a probability of 1%.
    """
    analysed, runs = linear(prepared, label, 4), sampled(prepared, label, workers=1)
    settled = prepared.times > 0
    mean, total = analysed.variance[settled].mean(axis=0), analysed.total[settled].mean(axis=0)
    for source in runs.sources:
        if source.kind in CONDITIONS:
            continue
        own = [i for i, s in enumerate(analysed.sources) if source.name in (s.name, s.group)]
        for i, value in enumerate(mean[own].sum(axis=0)):
            found = positive_mean_interval(runs.mse["alone", source.name][:, i], level)
            slack = 1.08 if source.group == "model" else 1.03
            if value > 0.01 * total[i]:
                assert found.low < slack * value, (source.name, i)
                assert found.high > value / slack, (source.name, i)
    for value, values in zip(total, runs.mse[ALL].T):
        assert value in positive_mean_interval(values, level)
    return analysed, runs


def test_a_matched_linear_filter_knows_its_error(tmp_path):
    """The sum of all sources is P of the filter; the Jacobians are differences, to 1e-9."""
    (tmp_path / "sled.xml").write_text(LINEAR)
    prepared = setup(tmp_path / "sled.xml", "ekf", duration=0.5, runs=4)
    found = linear(prepared, "ekf", 2)
    np.testing.assert_allclose(found.total, found.believed, rtol=1e-7)
    np.testing.assert_array_equal(found.together, 0.0)
    assert [s.name for s in found.sources][:4] == [
        "initial.x", "initial.y", "initial.x.vel", "initial.y.vel"
    ]  # fmt: skip


def test_wrong_damping_bias_drift_and_offset():
    prepared = setup(
        "pendulum", "ekf", 'filter.set={"dof_damping.hinge"=0.2}', "channels.gyro.bias=0.02",
        "channels.gyro.drift=0.02", "channels.gyro.drift_time=0.2", "channels.gyro.bias_walk=0.05",
        'start.offset={"hinge"=0.02}', 'truth.draw={"body_mass.arm"={relative_std=0.1}}',
        runs=40, duration=0.12,
    )  # fmt: skip
    analysed, runs = agree(prepared, "ekf")
    names = {source.name for source in runs.sources}
    assert {
        "parameter.dof_damping.hinge",
        "draw.body_mass.arm",
        "gyro.walk",
        "start.offset",
    } < names
    assert np.abs(analysed.together).max() > 0  # damping and offset are the same in every run


def test_bias_states_and_a_schmidt_filter():
    prepared = setup("cartpole_bias", "bias_ekf", runs=16, duration=0.04)
    agree(prepared, "bias_ekf")
    for overrides in ((), ('estimators.bias_ekf.considered=["bias.*"]',)):
        prepared = setup("cartpole_bias", "bias_ekf", *overrides, duration=0.5)
        found = linear(prepared, "bias_ekf", 2)
        np.testing.assert_allclose(found.total[1:], found.believed[1:], rtol=0.02)


def test_quadrotor_with_a_wrong_mass():
    wrong = 'filter.set={"body_mass.frame"=1.2}'
    prepared = setup("quadrotor", "ekf", wrong, runs=8, duration=0.05)
    analysed, _ = agree(prepared, "ekf")
    mass = [s.name for s in analysed.sources].index("parameter.body_mass.frame")
    assert analysed.variance[-1, mass, prepared.space.index("root.vz")] > 0.03**2


def test_late_readings_that_are_fused_as_current_ones():
    """All other sources off, the error is no random number: that of the linear analysis.

    With exact handling the latency adds nothing, and the batch is the filter of another gain.
    """
    late = ("channels.encoder.latency=0.05", "channels.encoder.rate=50.0")
    naive = setup("pendulum", "ekf", *late, 'filter.delays="naive"', runs=2, duration=0.6)
    found = linear(naive, "ekf", 2)
    place = [s.name for s in found.sources].index("encoder.timing")
    others = [s for s in sources(naive, "ekf") if s.kind != "timing"]
    alone = without(naive, "ekf", others)
    happened = recording.trajectory(alone, range(1))
    traces, _ = recording.estimated(alone, "ekf", range(1), happened)
    expected = linear(alone, "ekf", 1).variance
    timing = [s.name for s in linear(alone, "ekf", 1).sources].index("encoder.timing")
    np.testing.assert_allclose(traces.error[:, 0] ** 2, expected[:, timing], rtol=0.02, atol=1e-9)
    assert (found.variance[-1, place] > 0).all()
    exact = setup("pendulum", "ekf", *late, runs=2, duration=0.6)
    names = [s.name for s in sources(exact, "ekf")]
    assert names[-1] == "encoder.latency"
    analysed = linear(exact, "ekf", 2)
    np.testing.assert_allclose(analysed.total, analysed.believed, rtol=0.02)


def test_switched_off_sources_leave_the_random_numbers_of_the_others():
    """The truth without sensor noise is the truth; without one process noise the other stays."""
    whole = setup("pendulum", "ekf", "channels.gyro.bias=0.1", runs=3, duration=0.1)
    parts = {s.name: s for s in sources(whole, "ekf")}
    quiet = without(whole, "ekf", [parts["gyro.noise"], parts["encoder.noise"]])
    a, b = (recording.trajectory(p, range(3)) for p in (whole, quiet))
    np.testing.assert_array_equal(a.x, b.x)
    bias = without(whole, "ekf", [p for n, p in parts.items() if n != "gyro.bias"])
    traces, _ = recording.estimated(bias, "ekf", range(3), recording.trajectory(bias, range(3)))
    assert (np.abs(traces.error[-1, :, 1]) > 1e-3).all()
    everything = without(whole, "ekf", list(parts.values()))
    happened = recording.trajectory(everything, range(3))
    traces, _ = recording.estimated(everything, "ekf", range(3), happened)
    np.testing.assert_allclose(traces.error, 0.0, atol=1e-9)
    np.testing.assert_array_equal(traces.std[-1] > 0, True)  # it believes what it did


def test_what_estbench_budget_returns():
    found = estbench.budget("pendulum", "ekf", monte_carlo=True, runs=6, duration=0.1, workers=1)
    data = found.dataset()
    np.testing.assert_allclose(data.share.sum("source"), 1.0)
    linear_parts = data.variance_over_time.sum("source")
    np.testing.assert_allclose(linear_parts, data.total)
    total = data.alone.sum("source") + data.rest
    np.testing.assert_allclose(total, data.sampled_total)
    assert (data.alone_low < data.alone_high).all()
    averages = data.alone_over_time[:, 1:].mean("time")
    np.testing.assert_allclose(averages, data.alone)
    np.testing.assert_allclose(data.sampled_over_time[1:].mean("time"), data.sampled_total)
    finer = replace(found, sampled=None, by_source=True).dataset()
    assert "initial.hinge" in finer.source.values
    only = estbench.budget("pendulum", "pf", monte_carlo=True, runs=2, duration=0.03, workers=1)
    assert "pf" in only.notices[0] or "ParticleFilter" in only.notices[0]
    np.testing.assert_allclose(only.share.sum(axis=0), 1.0)


@pytest.mark.parametrize("label", ["kf", "pf", "rts"])
def test_estimators_without_a_gain(label):
    with pytest.raises(estbench.EstimatorError, match="use --monte-carlo"):
        estbench.budget("pendulum", label, duration=0.1)
