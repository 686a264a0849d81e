"""Which random streams a run asks for: each is asked for once, so no two uses share numbers."""

from collections import Counter

import gymnasium as gym
import numpy as np
import pytest

import estbench.envs  # noqa: F401
from estbench.experiment import setup
from estbench.montecarlo import batch as batches
from estbench.montecarlo import run as experiment
from estbench.randomness import counter, seeding

EVERYTHING = [
    *(
        f"channels.{name}.{setting}"
        for name in ("gyro", "accel")
        for setting in (
            "bias=0.02", "bias_walk=0.01", "drift=0.01", "drift_time=2.0", "scale_factor=0.01",
            "misalignment=0.01", "quantization=0.001", "deadband=0.001", "student_dof=5.0",
            "outlier_probability=0.1", "dropout=0.2", "dropout_length=3.0", "stuck=0.1",
            "rate=20.0", "jitter=0.02", "latency=0.03", "latency_std=0.01",
        )
    ),
    "channels.cart_encoder.rate=25.0",  # some steps have no reading
    'truth.draw={"body_mass.pole"={relative_std=0.2}, "body_mass.cart"={relative_std=0.1}}',
    "control={kind='random', std=0.5}",
    "bound=false",  # it takes the drawn parameters again, on purpose
    "filter.delays=naive",  # exact handling replays a step with the same numbers on purpose
]  # fmt: skip
ESTIMATORS = {
    "enkf": "{size=20}",
    "deterministic": "{type='enkf', form='deterministic', size=20}",
    "pf": "{size=50, threshold=1.0, regularization=0.5}",
}


@pytest.fixture
def asked(monkeypatch):
    """What is asked of seed sequences and of the counter-based numbers, with how often.

    A stream is made from the words of `SeedSequence(seed, spawn_key=(run, word of the purpose))`,
    by numpy or by `seeding.words`. Two purposes with one word would count as one asked twice.
    """
    requests = Counter()
    words, sequence, bits = seeding.words, np.random.SeedSequence, counter.bits

    def of_runs(seed, runs, purpose, count):
        requests.update(("stream", seed, int(run), purpose) for run in runs)
        return words(seed, runs, purpose, count)

    def of_one(entropy=None, *, spawn_key=(), **more):
        if spawn_key:
            requests["stream", entropy, *map(int, spawn_key)] += 1
        return sequence(entropy, spawn_key=spawn_key, **more)

    def counted(keys, count, purpose, numbers):
        for key, value in np.broadcast(np.atleast_1d(keys), count):
            requests["counter", int(key), int(value), purpose] += 1
        return bits(keys, count, purpose, numbers)

    monkeypatch.setattr(seeding, "words", of_runs)
    monkeypatch.setattr(np.random, "SeedSequence", of_one)
    monkeypatch.setattr(counter, "bits", counted)
    return requests


def twice(requests):
    return [request for request, count in requests.items() if count > 1]


@pytest.mark.parametrize("observe", ["truth", "estimate", "reference"])
@pytest.mark.parametrize("estimator", sorted(ESTIMATORS))
def test_a_run_asks_for_each_stream_once(asked, estimator, observe):
    overrides = [*EVERYTHING, f"control.observe={observe}"]
    if observe == "reference":
        overrides += ["control.kind=lqr"]  # with controls that see nothing it would not run
    overrides += [f"estimators.{estimator}={ESTIMATORS[estimator]}"]
    scenario = experiment.resolve("cartpole_imu", [estimator], overrides=overrides, duration=1.0)
    prepared = setup.build(scenario)
    asked.clear()  # the check of the controller draws for run 0
    for run in range(3):  # in a batch an EnKF also draws, and discards, for runs without a reading
        assert batches.run_batch(prepared, [run], "summary") is not None
    assert twice(asked) == []
    drawn = [request for request in asked if request[0] == "stream"]
    # Per run: start, process, control or the reference's key, two parameters, the estimator's key,
    # the encoder's noise; of each IMU channel noise, jitter, latency, 4 constants and 6 sequences.
    assert len(drawn) == 3 * (7 + 2 * 13)
    assert len(asked) > len(drawn) + 3 * 100  # the estimator's own numbers, two for each step


def check_streams(asked, episodes, looks):
    """Each stream once, and the same purposes for each episode of an environment."""
    drawn = {request: count for request, count in asked.items() if request[0] == "stream"}
    assert twice(drawn) == []
    # Per episode: start, process, two parameters, the estimator's key, the encoder's noise; of each
    # IMU channel noise, jitter, latency, 4 constants and 6 sequences; of each channel the look.
    purposes = Counter(purpose for *_, purpose in drawn)
    assert len(purposes) == 6 + 2 * 13 + looks
    assert set(purposes.values()) == {episodes}


@pytest.mark.parametrize(("observe", "looks"), [("state", 0), ("raw", 3)])
@pytest.mark.parametrize("estimator", sorted(ESTIMATORS))
def test_an_environments_episodes_ask_for_each_number_once(asked, estimator, observe, looks):
    more = [*EVERYTHING, f"estimators.{estimator}={ESTIMATORS[estimator]}"]
    env = gym.make(
        "estbench/Scenario-v0", scenario="cartpole_imu", overrides=more, estimator=estimator,
        observe=observe,
    )  # fmt: skip
    asked.clear()  # the check of the controller draws for run 0
    for seed in (1, 2, None):  # the last goes on with the seed before
        env.reset(seed=seed)
        for _ in range(40):  # more than a block of draws
            if any(env.step(env.action_space.sample())[2:4]):
                break
    check_streams(asked, 3, looks)
    assert twice(asked) == []
    assert sum(request[0] == "counter" for request in asked) > 3 * 10  # the estimator's own numbers


@pytest.mark.parametrize(("observe", "looks"), [("state", 0), ("raw", 3)])
def test_the_rows_of_a_vector_ask_for_each_number_once(asked, observe, looks):
    more = [*EVERYTHING, f"estimators.enkf={ESTIMATORS['enkf']}"]
    env = gym.make_vec(
        "estbench/Scenario-v0", num_envs=6, scenario="cartpole_imu", overrides=more,
        estimator="enkf", observe=observe,
    )  # fmt: skip
    asked.clear()
    env.reset(seed=7)
    again = np.array([False, True, False, True, True, False])
    for _ in range(3):
        for _ in range(12):
            env.step(np.zeros((6, 1), np.float32))
        env.reset(options={"reset_mask": again})
    # Not the counters: of rows that do not go on, or have no reading, an EnKF draws and discards.
    check_streams(asked, 6 + 3 * 3, looks)
