"""MuJoCo's model and data are found wherever an environment has them, or where one says."""

import copy
import logging
import types

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.utils import EzPickle

from estbench.envs import EstimatedObservation, RecordTruth, VectorEstimatedObservation
from estbench.envs.errors import EnvError
from tests.envs.changing import ARM, Arm

KWARGS = {"estimator": "ekf", "process_noise": 0.0, "initial_std": 0.0, "observe": "state"}


@pytest.fixture(autouse=True)
def _quiet(caplog):
    caplog.set_level(logging.ERROR, "estbench")


class Pointer:
    """As dm_control's wrappers of MjModel and MjData."""

    def __init__(self, inner):
        self._inner = inner

    @property
    def ptr(self):
        """The object of MuJoCo."""
        return self._inner


class Physics:
    """As dm_control's `Physics`."""

    def __init__(self):
        model = mujoco.MjModel.from_xml_string(ARM)
        self._model, self._data = Pointer(model), Pointer(mujoco.MjData(model))

    model = property(lambda self: self._model)
    data = property(lambda self: self._data)


class Elsewhere(gym.Env):
    """An environment without `model` and `data`; `kind` says where it has them instead."""

    def __init__(self, kind):
        self.observation_space = gym.spaces.Box(-1, 1, (1,))
        self.action_space = gym.spaces.Box(-1, 1, (1,))
        self.kind, self.ghost = kind, None
        self._make()

    def _make(self):
        physics = Physics()
        if self.kind == "dm_control":
            self._env = types.SimpleNamespace(_physics=physics, _n_sub_steps=2)
        elif self.kind == "quadruped":
            self.mjModel, self.mjData = physics.model.ptr, physics.data.ptr
            self._ghost_mjData = mujoco.MjData(self.mjModel)
        elif self.kind == "data only":
            self.simulation = types.SimpleNamespace(state=physics.data.ptr)
        else:
            self.sim = types.SimpleNamespace(model=physics.model.ptr, data=physics.data.ptr)
            if self.kind == "two":
                self.ghost = mujoco.MjData(physics.model.ptr)
        self.parts = physics.model.ptr, physics.data.ptr

    def reset(self, *, seed=None, options=None):
        """Dm_control's composer makes another physics in each episode."""
        super().reset(seed=seed)
        self._make()
        self.parts[1].qpos[:] = self.np_random.uniform(-0.1, 0.1, 3)
        if self.kind == "quadruped":  # it returns no info
            return np.zeros(1, np.float32)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        """Two physics steps."""
        self.parts[1].ctrl[:] = action
        mujoco.mj_step(*self.parts, 2)
        return np.zeros(1, np.float32), 0.0, False, False, {}


def follows(env):
    for _ in range(2):
        env.reset(seed=0)
        for _ in range(4):
            info = env.step(np.full(env.action_space.shape, 0.3, np.float32))[-1]
        assert np.abs(info["error"]).max() < 1e-9
        assert np.abs(info["truth"]).max() > 1e-3


@pytest.mark.parametrize("kind", ["dm_control", "quadruped", "sim", "data only"])
def test_they_are_found_without_help(kind):
    env = EstimatedObservation(Elsewhere(kind), **KWARGS)
    assert env._watch.frame_skip == (2 if kind == "dm_control" else 1)
    follows(env)


@pytest.mark.parametrize(
    "places",
    [
        {"data": lambda env: env.sim.data},
        {"model": lambda env: env.sim.model, "data": lambda env: env.sim.data},
        {"model": lambda env: env.sim, "data": lambda env: env.sim, "frame_skip": 2},
        {"model": "nominal", "data": lambda env: env.sim.data},
    ],
)
def test_a_place_is_a_function_of_the_environment(places):
    follows(EstimatedObservation(Elsewhere("two"), **places, **KWARGS))
    rows = gym.vector.SyncVectorEnv([lambda: Elsewhere("two")] * 2)
    follows(VectorEstimatedObservation(rows, **places, **KWARGS))


def test_a_place_is_an_object_or_a_function_of_nothing():
    class Fixed(Elsewhere):
        def _make(self):
            if not hasattr(self, "parts"):
                super()._make()

    inner = Fixed("dm_control")
    physics = inner._env._physics
    for model, data in ((physics, physics), (physics.model, physics.data), inner.parts):
        env = EstimatedObservation(inner, model=model, data=data, **KWARGS)
        follows(env)
    follows(EstimatedObservation(inner, data=lambda: physics.data, **KWARGS))
    by_function = EstimatedObservation(inner, data=lambda: physics.data, **KWARGS)
    with pytest.raises(EnvError, match=r"a copy would follow the original.*data=lambda env"):
        copy.deepcopy(by_function)


def test_other_processes_say_the_place_to_record_truth():
    rows = gym.vector.SyncVectorEnv([lambda: RecordTruth(Elsewhere("sim"))] * 2)
    follows(VectorEstimatedObservation(rows, **KWARGS))


@pytest.mark.parametrize(
    ("env", "kwargs", "message"),
    [
        (Elsewhere("two"), {}, r"has several MuJoCo data: ghost, sim.data; say which, as in"),
        (Arm(), {"model": "fixed"}, "model is 'fixed'; use 'follow', 'nominal', or where"),
        (Arm(), {"data": 3}, "data= is int, which has no MuJoCo data"),
        (Arm(), {"data": lambda env: env.model}, "data= leads to no MjData; say where"),
        (Arm(), {"model": lambda env: env.model}, "model= is given, but not data="),
        (Arm(), {"frame_skip": 0}, "frame_skip is 0; use an integer of at least 1"),
    ],
)
def test_mistakes(env, kwargs, message):
    with pytest.raises(EnvError, match=message):
        EstimatedObservation(env, **kwargs)


class Inner(Arm, EzPickle):
    """Its copy is a new environment, as that of Gymnasium's robots."""

    def __init__(self):
        Arm.__init__(self, "mass")
        EzPickle.__init__(self)


class Maze(gym.Env, EzPickle):
    """An environment with another one inside, as gymnasium-robotics' mazes."""

    def __init__(self):
        EzPickle.__init__(self)
        self.robot = Inner()
        self.observation_space, self.action_space = (
            self.robot.observation_space, self.robot.action_space,
        )  # fmt: skip

    def reset(self, *, seed=None, options=None):
        """That of the robot."""
        super().reset(seed=seed)
        return self.robot.reset(seed=seed)

    def step(self, action):
        """That of the robot."""
        return self.robot.step(action)


def test_a_copy_of_an_environment_with_another_inside_goes_on_as_the_original():
    env = EstimatedObservation(Maze(), **{**KWARGS, "initial_std": 0.05})
    env.reset(seed=4)
    env.step(np.full(1, 0.5))
    other = copy.deepcopy(env)
    for _ in range(3):
        a, b = (e.step(np.full(1, 0.5)) for e in (env, other))
        np.testing.assert_array_equal(a[0], b[0])
        np.testing.assert_array_equal(a[-1]["truth"], b[-1]["truth"])
    np.testing.assert_array_equal(env.reset()[0], other.reset()[0])
    assert other.unwrapped.robot.data is not env.unwrapped.robot.data
