import numpy as np
import pytest

from estbench.errors import StudyError
from estbench.experiment.setup import build
from estbench.scenario.load import resolve
from estbench.tuning import freedom
from estbench.tuning.parameters import Parameter, Prior, parse, parse_prior, with_priors


@pytest.fixture(scope="module")
def prepared():
    own = ["estimators.bias_ekf={bias={'gyro.y'=0.02}, walk={'gyro.y'=0.005}}",
           "estimators.ukf={}", "filter.channels.gyro.latency=0.05"]  # fmt: skip
    return build(resolve("cartpole_imu", ["ekf", "bias_ekf", "ukf"], runs=2, overrides=own))


def free(prepared, text, label="ekf"):
    (found,) = freedom.parameters(prepared, label, [parse(text)])
    return found


@pytest.mark.parametrize(
    ("text", "label", "start", "low", "high"),
    [
        ("filter.process_noise_scale", "ekf", 1.0, 1e-4, 1e4),
        ("filter.process_noise.density.pole.vel", "ekf", 0.01, 1e-6, 100.0),
        ("filter.set.body_mass.pole", "ekf", 0.2, 0.04, 1.0),
        ("start.inflate", "ekf", 1.0, 0.01, 100.0),
        ("start.inflate.pole.vel=0.5:3", "ekf", 1.0, 0.5, 3.0),
        ("filter.channels.gyro.latency", "ekf", 0.05, 0.0, 0.15),
        ('walk."gyro.y"', "bias_ekf", 0.005, 5e-5, 0.5),
        ("alpha=0.01:1", "ukf", None, 0.01, 1.0),
    ],
)
def test_where_a_parameter_starts_and_may_go(prepared, text, label, start, low, high):
    found = free(prepared, text, label)
    assert (found.low, found.high) == pytest.approx((low, high))
    if start is not None:
        assert found.start == pytest.approx(start)
    assert found.names[:2] == ("estimators", label)
    assert found.value(found.coordinate(found.start)) == pytest.approx(found.start)
    assert [found.value(x) for x in found.bounds] == [found.low, found.high]


def test_the_noise_of_a_channel_starts_at_what_the_filter_believes(prepared):
    channel = next(c for c in prepared.channels if c.name == "gyro")
    found = free(prepared, "filter.channels.gyro.noise.y")
    assert found.start == pytest.approx(np.sqrt(channel.cov[1, 1]))


def test_kinds(prepared):
    assert free(prepared, "filter.process_noise_scale").kind == "smooth"
    assert free(prepared, "filter.channels.gyro.latency").kind == "stepped"
    choice = free(prepared, "type=ekf,iekf")
    assert (choice.kind, choice.start, choice.value(1.0)) == ("choice", "ekf", "iekf")
    other = free(prepared, "type=ekf,examples.my_filter:MyFilter")
    assert other.choices == ("ekf", "examples.my_filter:MyFilter")
    pf = build(resolve("pendulum", ["pf"], runs=2))
    (size,) = freedom.parameters(pf, "pf", [parse("size=100:400")])
    assert size.kind == "whole"
    assert size.value(size.coordinate(150.3)) == 150


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("channels.gyro.noise", "it changes the truth or the readings"),
        ("simulation.runs", "it changes the truth or the readings"),
        ("filter.nothing", "unknown key"),
        ("filter", "is a table"),
        ("nothing", "ekf has no such setting"),
        ("estimators.ukf.alpha", "is not of 'ekf', the estimator that is tuned"),
        ("filter.channels.nose.noise", "no channel 'nose'"),
        ("filter.set.body_mass.nose", "no body 'nose'"),
        ("start.offset", "which gives no range"),
        ("filter.delays", "give its choices"),
        ("filter.window", "not set"),
    ],
)
def test_what_cannot_be_free(prepared, text, message):
    with pytest.raises(Exception, match=message):
        free(prepared, text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a=2:1", "the range is empty"),
        ("a=x:1", "is no range"),
        ("a=1", "leaves no choice"),
        ("a=1:inf", "the range is empty"),
    ],
)
def test_ranges_that_are_refused(text, message):
    with pytest.raises(StudyError, match=message):
        parse(text)


def test_nothing_free_and_one_key_twice(prepared):
    with pytest.raises(StudyError, match="nothing is free"):
        freedom.parameters(prepared, "ekf", [])
    twice = [
        parse("filter.process_noise_scale"),
        parse("estimators.ekf.filter.process_noise_scale"),
    ]
    with pytest.raises(StudyError, match="named twice"):
        freedom.parameters(prepared, "ekf", twice)


def test_priors():
    one = Parameter(("q",), "q", 1.0, 0.1, 10.0, True)
    assert parse_prior("q=2:1.5") == ("q", Prior(2.0, 1.5))
    (found,) = with_priors([one], [("q", Prior(2.0, 1.5))])
    z = np.log(np.array([2.0, 3.0]) / 2.0) / np.log(1.5)
    np.testing.assert_allclose(found.penalty(np.log([2.0, 3.0])), 0.5 * z**2)
    for key, prior, message in (
        ("r", Prior(1, 2), "it is not free"),
        ("q", Prior(1, 0.5), "a factor above 1"),
        ("q", Prior(-1, 2), "use one above 0"),
    ):
        with pytest.raises(StudyError, match=message):
            with_priors([one], [(key, prior)])
    with pytest.raises(StudyError, match="KEY=CENTRE:SPREAD"):
        parse_prior("q=2")
