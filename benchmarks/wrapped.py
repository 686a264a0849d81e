"""Environments of other libraries, wrapped: `python -m benchmarks.wrapped [PATTERN ...]`.

Each environment runs alone and wrapped, for the same seed and actions: the true states must be
equal to the last bit. The table has the median NEES/n of the default filter, the time that it adds
to a step, and the notices. Libraries that are not installed are left out: pip install
gymnasium-robotics, shimmy[dm-control], gym-quadruped, metaworld. Some of them do not run on
MuJoCo 4 by themselves; `MENDS` says why, and changes them for this trial.
"""

import fnmatch
import inspect
import logging
import sys
import time
import warnings
from collections.abc import Callable
from importlib import import_module
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

from estbench.envs import EstimatedObservation
from estbench.envs.member import Member
from estbench.envs.place import Place
from estbench.errors import EstbenchError

STEPS, EPISODES = 40, 2


def dm_control() -> str:
    """Remove the fields that MuJoCo 4 does not have from dm_control's table of fields."""
    table = import_module("dm_control.mujoco.wrapper.mjbindings.sizes").array_sizes
    for struct, kind in (("mjmodel", mujoco.MjModel), ("mjdata", mujoco.MjData)):
        for name in [name for name in table[struct] if not hasattr(kind, name)]:
            del table[struct][name]
    return "AttributeError: 'MjModel' object has no attribute 'flex_vertedge'"


def robotics() -> str:
    """Compare joint types as what they are: an integer is no `mjtJoint` in MuJoCo 4."""
    utils = import_module("gymnasium_robotics.utils.mujoco_utils")
    text = inspect.getsource(utils)
    old = "joint_type = model.jnt_type[joint_id]"
    new = "joint_type = mujoco.mjtJoint(int(model.jnt_type[joint_id]))"
    exec(compile(text.replace(old, new), str(utils.__file__), "exec"), vars(utils))
    return "AssertionError in set_joint_qpos and get_joint_qpos (Fetch, Kitchen, Hand)"


MENDS: dict[str, Callable[[], str]] = {
    "dm_control": dm_control,
    "gymnasium_robotics": robotics,
}
MADE = {
    "gymnasium": ["Ant-v5", "Hopper-v5"],
    "gymnasium_robotics": [
        "PointMaze_UMaze-v3", "AntMaze_UMaze-v5", "AdroitHandDoor-v1", "AdroitHandHammer-v1",
        "AdroitHandPen-v1", "AdroitHandRelocate-v1", "FetchReach-v4", "FetchPush-v4",
        "FetchPickAndPlace-v4", "FetchSlide-v4", "FrankaKitchen-v1", "HandReach-v3",
    ],
    "dm_control": [
        f"dm_control/{name}-v0"
        for name in ("cartpole-balance", "walker-walk", "quadruped-walk", "finger-spin",
                     "humanoid-stand", "manipulator-bring_ball", "ball_in_cup-catch")
    ],
    "gym_quadruped": ["gym_quadruped/mini_cheetah", "gym_quadruped/go2"],
    "metaworld": ["Meta-World/reach-v3"],
}  # fmt: skip


def make(name: str) -> gym.Env:
    """An environment by its name; those without an id by the class that makes them."""
    library, _, rest = name.partition("/")
    if library == "gym_quadruped":
        module = import_module("gym_quadruped.quadruped_env")
        return module.QuadrupedEnv(robot=rest)
    if library == "Meta-World":
        return gym.make("Meta-World/MT1", env_name=rest, seed=0)
    return gym.make(name)


def actions(env: gym.Env) -> list[Any]:
    """Random actions of moderate size."""
    env.action_space.seed(0)
    out = []
    for _ in range(STEPS * EPISODES):
        action = env.action_space.sample()
        space = env.action_space
        if isinstance(space, gym.spaces.Box) and np.isfinite(space.low).all():
            action = space.low + (space.high - space.low) * (
                0.5 + 0.3 * ((action - space.low) / (space.high - space.low) - 0.5)
            )
        elif isinstance(space, gym.spaces.Box):
            action = np.clip(action, -1.0, 1.0)
        out.append(np.asarray(action, space.dtype))
    return out


def trajectory(env: gym.Env, chosen: list[Any], info_truth: bool) -> tuple[np.ndarray, list, float]:
    """True states `(time, nx)`, infos, and seconds per step."""
    states, infos, spent, count = [], [], 0.0, 0
    for episode in range(EPISODES):
        env.reset(seed=episode)
        member = None if info_truth else Member(env, Place(env))
        for action in chosen[episode * STEPS : (episode + 1) * STEPS]:
            began = time.perf_counter()
            *_, terminated, truncated, info = env.step(action)
            spent, count = spent + time.perf_counter() - began, count + 1
            infos.append(info)
            if member is not None:
                data = member.data
                states.append(np.concatenate([data.qpos, data.qvel, data.act]))
            else:
                states.append(info["truth"])
            if terminated or truncated:
                break
    return np.array(states), infos, spent / count


def row(name: str) -> str:
    """One line of the table."""
    env = make(name)
    chosen = actions(env)
    alone, _, bare = trajectory(env, chosen, False)
    wrapped = EstimatedObservation(make(name), observe="state")
    truth, infos, spent = trajectory(wrapped, chosen, True)
    nees = np.array([info["nees"] / max(info["nees_dof"], 1) for info in infos])
    same = "equal" if np.array_equal(alone, truth) else "DIFFERS"
    model = wrapped._member.model
    head = (
        f"{name:32s} nv {model.nv:3d}  truth {same:7s} NEES/n {np.median(nees):9.3g}  "
        f"{1e3 * bare:7.2f} + {1e3 * (spent - bare):7.2f} ms"
    )
    return "\n".join([head, *(f"    {line}" for line in wrapped.notices)])


def main(patterns: list[str]) -> None:
    """Print the table."""
    warnings.filterwarnings("ignore")
    logging.getLogger("estbench").setLevel(logging.ERROR)
    for library, names in MADE.items():
        names = [n for n in names if not patterns or any(fnmatch.fnmatch(n, p) for p in patterns)]
        if not names:
            continue
        try:
            if library in MENDS:
                print(f"{library}: by itself {MENDS[library]()}")
            module = import_module("shimmy" if library == "dm_control" else library)
            if library == "gymnasium_robotics":
                gym.register_envs(module)
        except ImportError as error:
            print(f"{library}: not installed ({error})")
            continue
        for name in names:
            try:
                print(row(name), flush=True)
            except EstbenchError as error:
                print(f"{name:32s} REFUSED {error}", flush=True)
            except Exception as error:  # of the other library, which the trial is about
                print(f"{name:32s} fails: {type(error).__name__}: {error}"[:160], flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
