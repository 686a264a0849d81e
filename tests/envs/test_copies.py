"""Copies of environments go on as the originals do, to the last bit."""

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest

import estbench.envs  # noqa: F401  (registers the environments)
from estbench.envs import EstimatedObservation, RecordTruth, VectorEstimatedObservation
from estbench.envs.errors import EnvError


def wrapped(name="InvertedPendulum-v5", **kwargs):
    return EstimatedObservation(gym.make(name), estimator="ekf", **kwargs)


def vector_of_others(*wrappers):
    inner = gym.make_vec("InvertedPendulum-v5", 3, vectorization_mode="sync", wrappers=wrappers)
    return VectorEstimatedObservation(inner, estimator="ekf")


MAKERS = {
    "native": lambda: gym.make("estbench/CartPole-v0"),
    "late and with imperfections": lambda: gym.make(
        "estbench/Scenario-v0",
        scenario="cartpole_imu",
        observe="covariance",
        estimator="enkf",
        overrides=[
            "channels.gyro.latency=0.03",
            "channels.gyro.rate=20",
            "channels.gyro.jitter=0.01",
            "channels.gyro.bias_walk=0.01",
            'truth.draw={"body_mass.pole" = {relative_std=0.2}}',
        ],
    ),
    "raw": lambda: gym.make("estbench/CartPole-v0", estimator=None, observe="raw"),
    "native vector": lambda: gym.make_vec("estbench/CartPole-v0", 3, observe="belief"),
    "wrapped, its own observation": lambda: wrapped("HalfCheetah-v5"),
    "wrapped, the state": lambda: wrapped("Reacher-v5", observe="state"),
    "truth recorded": lambda: RecordTruth(gym.make("InvertedPendulum-v5")),
    "wrapped vector": vector_of_others,
    "wrapped vector, truth recorded": lambda: vector_of_others(RecordTruth),
}


def same(one, other):
    for a, b in zip(one[:-1], other[:-1], strict=True):
        np.testing.assert_array_equal(a, b)
    assert one[-1].keys() == other[-1].keys()
    for key, value in one[-1].items():
        np.testing.assert_array_equal(value, other[-1][key], err_msg=key)


@pytest.mark.parametrize("how", ["deepcopy", "pickle"])
@pytest.mark.parametrize("name", MAKERS)
def test_a_copy_goes_on_as_the_original(name, how):
    if how == "pickle" and name.startswith("wrapped vector"):
        pytest.skip("gymnasium's SyncVectorEnv holds functions that pickle refuses")
    env = MAKERS[name]()
    env.action_space.seed(3)
    actions = [env.action_space.sample() for _ in range(30)]
    env.reset(seed=5)
    for action in actions[:10]:
        env.step(action * 0.1)
    other = copy.deepcopy(env) if how == "deepcopy" else pickle.loads(pickle.dumps(env))
    expected = [env.step(action * 0.1) for action in actions[10:]]
    first, _ = env.reset(seed=None)
    for action, step in zip(actions[10:], expected, strict=True):
        same(step, other.step(action * 0.1))
    np.testing.assert_array_equal(first, other.reset(seed=None)[0])


def test_a_vector_in_other_processes_says_that_it_cannot_be_copied():
    inner = gym.make_vec("InvertedPendulum-v5", 2, vectorization_mode="async")
    env = VectorEstimatedObservation(inner, estimator="ekf", observe="state")
    try:
        with pytest.raises(EnvError, match="vectorization_mode='sync'"):
            copy.deepcopy(env)
    finally:
        env.close()


@pytest.mark.parametrize("name", ["native", "native vector", "wrapped, the state"])
def test_a_closed_environment_says_so(name):
    env = MAKERS[name]()
    env.reset(seed=0)
    env.close()
    for call in (lambda: env.step(env.action_space.sample()), env.reset):
        with pytest.raises(EnvError, match="closed; make a new one"):
            call()


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("name", ["native", "native vector", "wrapped, the state"])
def test_an_action_that_is_not_finite_is_refused(name, value):
    env = MAKERS[name]()
    env.reset(seed=0)
    with pytest.raises(EnvError, match=r"use a finite number"):
        env.step(np.full(env.action_space.shape, value, np.float32))


def test_a_wrapped_environment_takes_the_actions_that_it_takes_alone():
    env, plain = wrapped(observe="state"), gym.make("InvertedPendulum-v5")
    env.reset(seed=0), plain.reset(seed=0)
    action = np.full(env.action_space.shape, 30.0, np.float32)
    assert not env.action_space.contains(action)
    env.step(action), plain.step(action)
    np.testing.assert_array_equal(env.unwrapped.data.qpos, plain.unwrapped.data.qpos)
