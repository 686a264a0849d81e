"""A filter follows the environment: mocap bodies, parameters, forces; or keeps a model of its own.

With exact sensors, no process noise and an exact start the filter's error is that of its model.
"""

import copy
import logging
import pickle
import re
from typing import ClassVar

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv
from gymnasium.vector import AutoresetMode

from estbench.envs import EstimatedObservation, RecordTruth, VectorEstimatedObservation
from estbench.envs.errors import EnvError
from tests.envs.changing import ARM, Arm

EXACT = {
    "estimator": "ekf", "process_noise": 0.0, "initial_std": 0.0, "observe": "state",
    "sensors": {"shoulder": {"type": "jointpos", "object": "shoulder", "noise": 0.0}},
}  # fmt: skip
NOISY = {"estimator": "ukf", "process_noise": 1e-3, "observe": "state"}
PARAMETERS = ("mass", "compiled", "options", "gains", "damping")
ALWAYS = ("mocap", "released")


@pytest.fixture(autouse=True)
def _quiet(caplog):
    caplog.set_level(logging.ERROR, "estbench")


def infos(env, count=12, seeds=(1, None, 7)):
    out = []
    for seed in seeds:
        env.reset(seed=seed)
        out += [env.step(np.array([0.8 * (-1) ** k]))[-1] for k in range(count)]
    return out


def largest_error(env, **kwargs):
    return max(np.abs(info["error"]).max() for info in infos(env, **kwargs))


@pytest.mark.parametrize("kind", [*PARAMETERS, *ALWAYS, "push"])
def test_what_the_environment_changes_is_followed(kind):
    env = EstimatedObservation(Arm(kind), **EXACT)
    assert largest_error(env) < 1e-9
    nominal = EstimatedObservation(Arm(kind), model="nominal", **EXACT)
    error = largest_error(nominal)
    assert error < 1e-9 if kind in ALWAYS else error > 1e-3
    said = {
        "mocap": r"mocap bodies .hand. are known inputs", "released": "eq_active.; the filter know",
        "push": "xfrc_applied.; the filter knows it", "mass": "changes its model .body_mass",
        "compiled": "changes its model", "options": "opt.gravity", "damping": "dof_damping",
        "gains": "actuator_gainprm",
    }  # fmt: skip
    assert re.search(said[kind], "\n".join(env.notices))
    if kind in PARAMETERS:
        assert "model='nominal' keeps the first" in "\n".join(env.notices)
        assert "the filter keeps the first" in "\n".join(nominal.notices)
    assert len(env.notices) == len(set(env.notices))


def test_the_truth_is_that_of_the_environment_alone():
    env, alone = EstimatedObservation(Arm("mass"), **EXACT), Arm("mass")
    shown = infos(env, seeds=(1, None))
    for k, info in enumerate(shown):
        if k % 12 == 0:
            alone.reset(seed=(1, None)[k // 12])
        alone.step(np.array([0.8 * (-1) ** (k % 12)]))
        np.testing.assert_array_equal(info["truth"], [*alone.data.qpos, *alone.data.qvel])


def test_a_change_by_a_wrapper_outside_is_seen_at_the_next_step():
    env = EstimatedObservation(Arm(), **EXACT)
    env.reset(seed=0)
    env.unwrapped.model.body_mass[3] *= 4
    assert np.abs(env.step(np.zeros(1))[-1]["error"]).max() < 1e-9
    env.unwrapped.model.geom_rgba[:] = 0.5  # of no consequence
    before = len(env.notices)
    env.step(np.zeros(1))
    assert len(env.notices) == before


def test_model_set_remains_a_mismatch_of_the_followed_model():
    kwargs = {**EXACT, "model_set": {"dof_damping.wrist": 0.5}}
    assert largest_error(EstimatedObservation(Arm("mass"), **kwargs)) < 1e-9  # the value it has
    kwargs["model_set"] = {"dof_damping.wrist": 2.0}
    assert largest_error(EstimatedObservation(Arm("mass"), **kwargs)) > 1e-3


def nees(model, kind, seeds=range(1, 13)):
    env = EstimatedObservation(Arm(kind), model=model, **NOISY)
    return np.mean([i["nees"] / i["nees_dof"] for i in infos(env, seeds=seeds)])


def test_with_noise_the_followed_filter_is_consistent_and_the_nominal_one_is_not():
    """Seeded; over 12 episodes the mean of NEES/n of a consistent filter has a std below 0.15.

    Below 1 it is for the process noise, which these environments do not have.
    """
    assert nees("follow", "mocap") < 1.6
    assert nees("follow", "mass") < 1.6
    assert nees("nominal", "mass") > 5


def test_late_readings_are_repeated_under_the_inputs_of_their_time():
    sensors = {
        name: {"type": "jointpos", "object": name, "noise": 0.0, "latency": 0.05}
        for name in ("shoulder", "elbow")
    }
    kwargs = {**EXACT, "sensors": sensors}
    for kind in ("mocap", "damping", "push"):
        assert largest_error(EstimatedObservation(Arm(kind), **kwargs)) < 1e-9


@pytest.mark.parametrize("how", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
@pytest.mark.parametrize("kind", ["mass", "mocap", "compiled"])
def test_a_copy_goes_on_as_the_original(kind, how):
    env = EstimatedObservation(Arm(kind), **NOISY)
    infos(env, 5, (3, None))
    other = how(env)
    for a, b in zip(infos(env, 6, (None, None)), infos(other, 6, (None, None)), strict=True):
        for key, value in a.items():
            np.testing.assert_array_equal(value, b[key], err_msg=key)


def vector(kind, mode, how="sync", record=True, rows=3, **kwargs):
    return VectorEstimatedObservation(
        gym.vector.SyncVectorEnv(
            [lambda: RecordTruth(Arm(kind)) if record else Arm(kind)] * rows, autoreset_mode=mode
        )
        if how == "sync"
        else gym.vector.AsyncVectorEnv(
            [lambda: RecordTruth(Arm(kind)) if record else Arm(kind)] * rows, autoreset_mode=mode
        ),
        **kwargs,
    )


@pytest.mark.parametrize(
    ("mode", "record"),
    [("NextStep", False), ("NextStep", True), ("SameStep", True), ("Disabled", False)],
)
@pytest.mark.parametrize("kind", ["mass", "mocap"])
def test_each_row_of_a_vector_follows_its_own(kind, mode, record):
    env = vector(kind, AutoresetMode(mode), record=record, **EXACT)
    env.reset(seed=5)
    over = np.zeros(3, bool)
    for k in range(30):
        if mode == "Disabled" and (over.any() or k == 7):
            mask = over if over.any() else np.array([False, True, False])
            env.reset(options={"reset_mask": mask})
        *_, over, info = env.step(np.full((3, 1), 0.8 * (-1) ** k))
        assert np.abs(info["error"]).max() < 1e-9
        if "final_info" in info:
            assert np.abs(info["final_info"]["error"]).max() < 1e-9
    if kind == "mass":
        assert sum("body_mass" in line for line in env.notices) == 1
        assert np.abs(np.diff(info["truth"][:, 0])).min() > 1e-6
    assert not [key for key in info if key.startswith(("estbench_", "_estbench_"))]


@pytest.mark.parametrize("record", [True, False])
def test_environments_in_other_processes(record):
    env = vector("mass", AutoresetMode.NEXT_STEP, "async", record, rows=2, **EXACT)
    try:
        env.reset(seed=5)
        for k in range(15):
            info = env.step(np.full((2, 1), 0.8 * (-1) ** k))[-1]
            assert np.abs(info["error"]).max() < 1e-9
    finally:
        env.close()


class Target(InvertedPendulumEnv):
    """A goal of the policy is a parameter of the model, drawn per episode, in the observation."""

    def __init__(self):
        super().__init__()
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (5,), np.float64)

    def reset_model(self):
        """Draw the goal."""
        self.model.site_pos[:] = 0 if not self.model.nsite else self.np_random.uniform(-1, 1)
        self.model.body_pos[0, 0] = self.np_random.uniform(-1, 1)
        self.model.geom_friction[:, 0] = self.np_random.uniform(0.5, 1)
        return super().reset_model()

    def _get_obs(self):
        return np.append(super()._get_obs(), self.model.geom_friction[0, 0])


def test_the_environments_own_observation_is_of_the_model_that_it_has():
    env = EstimatedObservation(Target(), estimator="ekf")
    rows = gym.vector.SyncVectorEnv([Target, Target])
    both = VectorEstimatedObservation(rows, estimator="ekf")
    shown = both.reset(seed=1)[0]
    for seed in (1, 2):
        observation, _ = env.reset(seed=seed)
        assert observation[-1] == env.unwrapped.model.geom_friction[0, 0] == shown[seed - 1, -1]


class Led(MujocoEnv):
    """A Gymnasium robot that a mocap body leads, which the policy sees."""

    metadata: ClassVar = {
        "render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"], "render_fps": 50,
    }  # fmt: skip

    def __init__(self, path):
        space = gym.spaces.Box(-np.inf, np.inf, (12,), np.float64)
        super().__init__(path, 5, space)

    def reset_model(self):
        """The arm on its target."""
        self.set_state(np.array([0.6, -1.2, 0.0]), np.zeros(3))
        return self._get_obs()

    def step(self, action):
        """Move the target, then the physics."""
        self.data.mocap_pos[0, 2] += 0.004
        self.do_simulation(action, self.frame_skip)
        return self._get_obs(), 0.0, False, False, {}

    def _get_obs(self):
        data = self.data
        return np.concatenate([data.qpos, data.qvel, data.mocap_pos[0], data.body("wrist").xpos])


def test_the_environments_own_observation_at_an_exact_estimate_with_a_mocap_body(tmp_path):
    (tmp_path / "arm.xml").write_text(ARM)
    kwargs = {key: value for key, value in EXACT.items() if key != "observe"}
    env = EstimatedObservation(Led(str(tmp_path / "arm.xml")), **kwargs)
    alone = Led(str(tmp_path / "arm.xml"))
    shown = [env.reset(seed=0)[0], *(env.step(np.full(1, 0.3))[0] for _ in range(8))]
    own = [alone.reset(seed=0)[0], *(alone.step(np.full(1, 0.3))[0] for _ in range(8))]
    np.testing.assert_allclose(shown, own, atol=1e-9)
    assert np.ptp(np.array(own)[:, 8]) > 0.02


class Other(Arm):
    """A model of another size, or another timestep."""

    def reset(self, *, seed=None, options=None):
        """Make it in the second episode."""
        out = super().reset(seed=seed)
        self.episodes = getattr(self, "episodes", 0) + 1
        if self.episodes == 2 and self.kind == "timestep":
            self.model.opt.timestep = 0.002
        return out


def test_what_cannot_be_followed_is_said():
    env = EstimatedObservation(Other("timestep"), **EXACT)
    env.reset(seed=0)
    with pytest.raises(EnvError, match=r"changed its timestep to 0.002 s.*make a new one"):
        env.reset()
