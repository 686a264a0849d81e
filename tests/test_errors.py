"""Where a user's code raised: one text for filters, functions, schedules and controllers."""

import re

import pytest

import estbench
from estbench.errors import EstbenchError, ModelError, did_you_mean, user_error_location
from estbench.models.calls import call

MODULE = """
import numpy as np

from estbench.estimators.ekf import EKF


class Bug(EKF):
    def update(self, belief, *arguments, **options):
        return self.helper(belief)

    def helper(self, belief):
        return belief.no_such


class Deep(EKF):
    def mean(self, belief):
        return np.linalg.inv(np.zeros((2, 3)))


class Init(EKF):
    def __init__(self, model):
        raise ValueError("unlucky")


def control(t, x):
    return x.no_such


def reading(x, u, t):
    return x[..., 99]


def schedule(t):
    return {}["calm"]
"""
CHANNEL = "channels.h.function=mine_place:reading"
CASES = {
    "filter": (["mine_place:Bug"], (), r"no_such' \(mine_place\.py:12, in helper\)$"),
    "in numpy": (["mine_place:Deep"], (), r" \(mine_place\.py:17, in mean\)$"),
    "constructor": (["mine_place:Init"], (), r"unlucky \(mine_place\.py:22, in __init__\)$"),
    "controller": (
        ["ekf"],
        ("control.kind=user", "control.function=mine_place:control"),
        r"no_such' \(mine_place\.py:26, in control\)$",
    ),
    "channel": (
        ["ekf"],
        (CHANNEL, 'sensors=["h"]'),
        r"\(mine_place\.py:30, in reading\); it is called as",
    ),
    "schedule": (
        ["ekf"],
        ("channels.pole_encoder.schedule=mine_place:schedule",),
        r"KeyError: 'calm' \(mine_place\.py:34, in schedule\)$",
    ),
}


@pytest.mark.parametrize(("estimators", "overrides", "message"), CASES.values(), ids=CASES)
def test_the_line_of_the_users_file_is_named(estimators, overrides, message, tmp_path, monkeypatch):
    (tmp_path / "mine_place.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(EstbenchError, match=message):
        estbench.run("cartpole", estimators, runs=2, duration=0.05, overrides=overrides)


def test_an_error_without_a_users_line():
    assert user_error_location(KeyError("gain")) == "KeyError: 'gain'"
    with pytest.raises(TypeError) as raised:
        did_you_mean(None, ["a"])  # pyright: ignore[reportArgumentType]
    assert re.fullmatch(
        r"TypeError: .* \(test_errors\.py:\d+, in test_an_error.*\)",
        user_error_location(raised.value),
    )
    raised.value.__traceback__ = raised.tb.tb_next  # without this file
    assert user_error_location(raised.value) == f"TypeError: {raised.value}"


def test_the_line_of_a_models_function():
    def gain(t):
        raise KeyError("gain")

    with pytest.raises(
        ModelError, match=r"^f raised KeyError: .* \(test_errors\.py:\d+, in gain\);"
    ):
        call("f", gain, 0.0)
