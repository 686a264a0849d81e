"""When schedules are asked: Q_s at an interval's start, a noise and its R when a reading is taken.

The schedules are functions that record the times at which they are asked, in truth and filter.
"""

from collections import Counter

import gymnasium as gym
import numpy as np
import pytest

import estbench.envs  # noqa: F401
from estbench.experiment import setup
from estbench.montecarlo import batch as batches
from estbench.montecarlo import run as experiment
from tests.helpers import DISCRETE

HERE = __name__
ASKED: dict[str, Counter] = {"process": Counter(), "noise": Counter(), "believed": Counter()}


def record(what, t):
    ASKED[what][round(t, 9)] += 1


def process(t):
    record("process", t)
    return 1.0 + t


def process_matrix(t):
    record("process", t)
    return np.diag([0.0, 0.0, 0.01, 0.01 + t])


def noise(t):
    record("noise", t)
    return 1.0 + t


def noise_matrix(t):
    record("noise", t)
    return 1e-4 * (1.0 + t) * np.eye(1)


def believed(t):
    record("believed", t)
    return 1.0 + t


LATE = [  # 20 Hz, due at 0.02, 0.07, ..., 30 ms late, in a loop of 10 ms
    "channels.pole_encoder.rate=20.0", "channels.pole_encoder.phase=0.02",
    "channels.pole_encoder.latency=0.03", "filter.channels.cart_encoder.follow_schedule=false",
]  # fmt: skip
JITTER = [  # this filter takes the time at which a reading was due for that of its sampling
    "channels.pole_encoder.jitter=0.01", "filter.channels.pole_encoder.timestamps=due",
    "bound=false", "control.observe='truth'",
]  # fmt: skip
DURATION = 0.4
DUE = [round(0.02 + 0.05 * k, 9) for k in range(8)]


def schedules(suffix=""):
    return [
        f'process_noise.schedule="{HERE}:process{suffix}"',
        f'channels.pole_encoder.schedule="{HERE}:noise{suffix}"',
        f'filter.channels.pole_encoder.schedule="{HERE}:believed"',
    ]


def run(overrides, estimator="ekf"):
    """Starts of the intervals; `ASKED` is then what was asked after the set-up."""
    scenario = experiment.resolve(
        "cartpole", [estimator], overrides=[*LATE, *overrides], duration=DURATION
    )
    prepared = setup.build(scenario)
    for times in ASKED.values():
        times.clear()
    assert batches.run_batch(prepared, range(2), "summary") is not None
    return [round(instant.start, 9) for instant in prepared.instants]


@pytest.mark.parametrize("jitter", [[], JITTER], ids=["punctual", "jitter"])
@pytest.mark.parametrize(
    ("kind", "suffix"),
    [("additive", ""), ("additive", "_matrix"), ("force", ""), ("actuator", "")],
)
def test_times_asked_by_truth_and_filter(kind, suffix, jitter):
    density = f"process_noise={{kind='{kind}', density=0.01}}"
    starts = run([density, *schedules(suffix), *jitter])
    assert sorted(ASKED["process"]) == starts  # none is the end of the last interval
    # Once by the truth and once by the filter at least; it predicts again after a late reading.
    assert min(ASKED["process"].values()) >= 2
    if not jitter:
        assert sorted(ASKED["noise"]) == DUE
        assert sorted(ASKED["believed"]) == [t for t in DUE if t + 0.03 <= DURATION]
    else:  # the last may come late or not
        asked = np.array(sorted(ASKED["noise"]))
        apart = np.abs(asked[:, None] - DUE).min(axis=1)
        assert 0 < apart.max() <= 0.01 + 1e-9
        assert set(ASKED["believed"]) <= set(DUE)


@pytest.mark.parametrize("estimator", DISCRETE)
def test_times_asked_by_each_estimator(estimator):
    starts = run(schedules(), estimator)
    assert sorted(ASKED["process"]) == starts
    assert min(ASKED["process"].values()) >= 2
    assert sorted(ASKED["believed"]) == [t for t in DUE if t + 0.03 <= DURATION]


def test_the_continuous_filter_asks_for_its_noise_within_the_interval():
    starts = run(schedules(), "cd_ekf")
    asked = np.array(sorted(ASKED["process"]))
    assert set(starts) <= set(asked)
    assert asked.max() <= DURATION + 1e-9
    assert sorted(ASKED["believed"]) == [t for t in DUE if t + 0.03 <= DURATION]


def test_times_asked_by_an_environment():
    env = gym.make("estbench/CartPole-v0", overrides=[*LATE, *schedules()])
    env.reset(seed=0)
    for times in ASKED.values():
        times.clear()
    for _ in range(20):
        env.step(env.action_space.sample())
    starts = [round(0.01 * k, 9) for k in range(20)]
    assert set(starts) == set(ASKED["process"])
    assert min(ASKED["process"].values()) >= 2
    due = [t for t in DUE if t <= 0.2]
    assert set(ASKED["noise"]) == set(due)
    assert set(ASKED["believed"]) == {t for t in due if t + 0.03 <= 0.2}
