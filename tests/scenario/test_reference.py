"""The reference estimator belongs to the scenario file, not to what is put under test."""

import pytest

from estbench.errors import ScenarioError
from estbench.scenario import reference
from estbench.scenario.load import load, override, parse, resolve

ON = "control.observe=reference"


def chosen(name, estimators=None, overrides=()):
    found = resolve(name, estimators, overrides=[ON, *overrides]).control.estimator
    assert isinstance(found, dict)
    return found


def test_the_default_is_the_first_exact_ekf_of_the_file():
    assert chosen("pendulum") == {"type": "ekf"}
    bias = chosen("cartpole_bias")
    assert bias == {"type": "estbench.estimators.biased:BiasEKF", **bias}
    assert bias["bias"] == {"gyro.y": 0.02}
    ukf_first = "estimators={a={type='ukf'}, b={type='iekf', iterations=4}, ekf={}}"
    mixed = load("pendulum", [ukf_first])
    assert override(mixed, [ON]).control.estimator == {"type": "iekf", "iterations": 4}


@pytest.mark.parametrize(
    "table", ["{a={type='ukf'}}", "{a={type='ekf', delays='naive'}}", "{ekf={start={inflate=9.0}}}"]
)
def test_without_an_exact_ekf_it_is_a_plain_one(table):
    scenario = load("pendulum", [f"estimators={table}"])
    assert override(scenario, [ON]).control.estimator == {"type": "ekf"}


@pytest.mark.parametrize(
    ("estimators", "overrides"),
    [
        (["ukf"], []),
        (["ekf"], ["estimators.ekf.covariance_update=simplified"]),
        (None, ["estimators={ukf={}}"]),
        (["naive"], ["estimators.naive.covariance_update=simplified"]),
    ],
)
def test_what_is_put_under_test_does_not_change_it(estimators, overrides):
    assert chosen("quadrotor_delayed", estimators, overrides) == {"type": "ekf"}


def test_it_may_be_named_by_label_name_or_table():
    assert chosen("quadrotor_delayed", ["ukf"], ["control.estimator=naive"]) == {
        "type": "ekf", "delays": "naive",
    }  # fmt: skip
    assert chosen("pendulum", None, ["control.estimator=ckf"]) == {"type": "ckf"}
    assert chosen("pendulum", None, ["control.estimator=my.module:Own"])["type"] == "my.module:Own"
    new = ["control.estimator=own", "estimators.own={type='ukf', alpha=0.5}"]
    assert chosen("pendulum", None, new) == {"type": "ukf", "alpha": 0.5}
    table = "control.estimator={type='ukf', alpha=0.5}"
    assert chosen("pendulum", None, [table]) == {"type": "ukf", "alpha": 0.5}


def test_it_stands_in_the_stored_scenario_and_stays():
    scenario = resolve("quadrotor_delayed", ["ukf"], overrides=[ON])
    again = parse(scenario.to_toml())
    assert again == scenario
    assert reference.settled(again) == scenario
    assert override(again, ["estimators.ukf.alpha=0.5"]).control == scenario.control


def test_a_controller_that_sees_something_else_has_none():
    for who in ("truth", "estimate"):
        assert resolve("cartpole", overrides=[f"control.observe={who}"]).control.estimator is None


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("efk", r"control.estimator: no estimator 'efk' .did you mean 'ekf'"),
        ("{alpha=0.5}", r"control.estimator is .*; a table needs a type"),
        ("3", r"control.estimator: .*string"),
    ],
)
def test_a_mistake_is_named(value, message):
    with pytest.raises(ScenarioError, match=message):
        chosen("pendulum", None, [f"control.estimator={value}"])
