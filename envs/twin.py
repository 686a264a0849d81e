"""The environment's own observation at an estimated state, from a twin of the environment."""

import copy
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces
from gymnasium.envs.mujoco import MujocoEnv

from estbench.envs.errors import EnvError
from estbench.robots import layout
from estbench.robots.given import INPUTS, STATE
from estbench.shapes import Array

_OWN = frozenset(("model", "data", "mujoco_renderer", "_np_random", "_np_random_seed", "spec"))


def chosen(observe: str | None, env: gym.Env) -> tuple[str, tuple[str, ...]]:
    """What is observed, and a notice about it: by default `env`, or `state` without a twin."""
    if observe is not None:
        return observe, ()
    try:
        check_twin(env)
    except EnvError as error:
        return "state", (f"observing the estimated state: {error}",)
    return "env", ()


def check_twin(env: gym.Env) -> None:
    """Refuse an environment that can have no twin.

    Raises:
        EnvError: it lacks a method, or wrappers have changed its observation.
    """
    base: Any = env.unwrapped
    if not isinstance(vars(base).get("data"), mujoco.MjData):
        raise EnvError(
            f"observe='env' needs {type(base).__name__}.data, MuJoCo's data under this name; use "
            "observe='state', 'belief' or 'raw'"
        )
    for name in ("_get_obs", "do_simulation"):
        if not callable(getattr(base, name, None)):
            raise EnvError(
                f"observe='env' needs {type(base).__name__}.{name}(), which Gymnasium's MuJoCo "
                "environments have; use observe='state', 'belief' or 'raw'"
            )
    if env.observation_space != base.observation_space:
        raise EnvError(
            f"observe='env' computes the observation of {type(base).__name__}, but a wrapper "
            "between has changed it; put EstimatedObservation directly around the environment "
            "and the other observation wrappers around EstimatedObservation"
        )


class _NoMoreThanTheState:
    """MuJoCo's data for an observation that reads qpos, qvel, act and the time, and nothing else.

    Attributes:
        asked: whether anything else was read.
    """

    def __init__(self, model: mujoco.MjModel, x: Array, t: float):
        self.qpos, self.qvel = x[: model.nq].copy(), x[model.nq : model.nq + model.nv].copy()
        self.act, self.time, self.asked = x[model.nq + model.nv :].copy(), t, False

    def __getattr__(self, name: str) -> Any:
        self.asked = True
        raise AttributeError(name)


class Twin:
    """A shallow copy of an environment with a `data` of its own; the original is never written.

    MuJoCo's derived quantities (body positions, contact forces, ...) are, after a step, those of
    the state before the last physics step; an environment's observation mixes them with the new
    qpos and qvel. The twin does the same: it steps from the last estimate under the same control
    and then takes the new estimate's qpos, qvel and act. With an exact estimate its observation is
    the environment's own. The physics is left out as long as the observation reads nothing but the
    state. Contact forces at an estimate are those of the estimated pose: near a
    contact a small error of height turns a force on or off.

    Args:
        env: an environment whose unwrapped has `_get_obs` and `do_simulation`.
        data: of the twin, if it is a copy of another.

    Raises:
        EnvError: it has not, or wrappers have changed its observation.
    """

    def __init__(self, env: gym.Env, data: mujoco.MjData | None = None):
        check_twin(env)
        base: Any = env.unwrapped
        self.space = base.observation_space
        self._base = base
        # Not copy.copy: Gymnasium's environments are EzPickle, whose copy is a new environment.
        self._env = object.__new__(type(base))
        vars(self._env).update(vars(base))
        self._env.mujoco_renderer = None
        self._env.data = data or mujoco.MjData(base.model)
        self._env._np_random = np.random.default_rng(0)  # should _get_obs draw noise of its own
        self._own = {name: value for name, value in vars(self._env).items() if name in _OWN}
        self._quaternions = [
            slice(q, q + 4) for q in layout.state_space(base.model).quaternions[:, 0]
        ]
        # A method of the environment's own may set what its observation reads.
        self._physics = any(
            getattr(type(base), name, None) is not getattr(MujocoEnv, name)
            for name in ("do_simulation", "_step_mujoco_simulation")
        )
        low, high = getattr(self.space, "low", -np.inf), getattr(self.space, "high", np.inf)
        self._bounded = bool(np.isfinite(low).any() or np.isfinite(high).any())

    @property
    def data(self) -> mujoco.MjData:
        """MuJoCo's data of the twin, which remember the last step."""
        return self._env.data

    def reset(self, x: Array, truth: Array, inputs: Array, t: float = 0.0) -> Any:
        """The observation of a new episode.

        Gymnasium's environments start with quaternions that are not of unit length, and show these;
        the unit quaternions of the estimate get the length of the true ones. It does not change
        the rotation.

        Args:
            x: estimate `(nx,)`.
            truth: true state `(nx,)`.
            inputs: all inputs, see `robots.given`.
            t: time, s.
        """
        env = self._sync()
        mujoco.mj_resetData(env.model, env.data)
        x = x.copy()
        for part in self._quaternions:
            x[part] *= np.linalg.norm(truth[part]) / np.linalg.norm(x[part])
        mujoco.mj_setState(env.model, env.data, np.concatenate([[t], x, inputs]), STATE | INPUTS)
        mujoco.mj_forward(env.model, env.data)
        return self._observation()

    def step(self, before: Array, inputs: Array, nstep: int, x: Array, t: float) -> Any:
        """The observation after a step.

        Args:
            before: the last estimate `(nx,)`.
            inputs: all inputs that were held, see `robots.given`.
            nstep: physics steps.
            x: the new estimate `(nx,)`.
            t: time at x, s.
        """
        env = self._sync()
        if not self._physics:
            data = env.data = _NoMoreThanTheState(env.model, x, t)
            try:
                observation = self._observation()
            except Exception:  # of code that was given no `MjData`: it may be right with one
                data.asked = True
            env.data = self._own["data"]
            if not data.asked:
                return observation
            self._physics = True
        model, data, n = env.model, env.data, 1 + len(x)
        state = np.empty(n + len(inputs))
        state[0], state[1:n], state[n:] = t - nstep * model.opt.timestep, before, inputs
        mujoco.mj_setState(model, data, state, STATE | INPUTS)
        env.do_simulation(inputs[: model.nu], nstep)
        state[0], state[1:n] = t, x
        mujoco.mj_setState(model, data, state[:n], STATE)
        return self._observation()

    def _sync(self) -> Any:
        """Take over the environment's attributes as they are now (a goal, a counter, ...).

        Those that came since the last step are added, those that went are removed.
        """
        mine, theirs = vars(self._env), vars(self._base)
        if self._own["model"] is not theirs["model"]:  # the environment has made another one
            self._own |= {"model": theirs["model"], "data": mujoco.MjData(theirs["model"])}
        mine.update(theirs)
        mine.update(self._own)
        if len(mine) > len(theirs):
            for name in mine.keys() - theirs.keys() - self._own.keys():
                del mine[name]
        return self._env

    def _observation(self) -> Any:
        observation = self._env._get_obs()
        if isinstance(self.space, spaces.Box):
            if self._bounded:  # an estimate may lie a little outside of what the truth can reach
                observation = np.minimum(np.maximum(observation, self.space.low), self.space.high)
            return np.array(observation, self.space.dtype)
        return copy.deepcopy(observation)
