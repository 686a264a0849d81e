# pyright: reportOptionalMemberAccess=false, reportArgumentType=false
# pyright: reportOptionalSubscript=false, reportGeneralTypeIssues=false
import gc
import json
import logging
import os
import subprocess
import sys
import warnings

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

from estbench.envs import EstimatedObservation, sensors
from estbench.envs.errors import EnvError
from estbench.errors import CovarianceError, DimensionError, EstimatorError, ScenarioError
from estbench.robots import sharing

FREE = "<mujoco/>"
ROBOTS = (
    "InvertedPendulum", "InvertedDoublePendulum", "Reacher", "Pusher", "Swimmer", "HalfCheetah",
    "Hopper", "Walker2d", "Ant", "Humanoid", "HumanoidStandup",
)  # fmt: skip
OTHERS = ("state", "belief", "covariance", "raw")
SLIDE = {"slider_encoder": {"type": "jointpos", "object": "slider", "noise": 0.02}}


@pytest.fixture(autouse=True)
def _quiet(caplog):
    caplog.set_level(logging.ERROR, "estbench")


def wrapped(name="InvertedPendulum", make=None, **kwargs):
    return EstimatedObservation(gym.make(f"{name}-v5", **(make or {})), **kwargs)


def steps(env, count=30, seed=0):
    env.action_space.seed(seed)
    out = [(*env.reset(seed=seed),)]
    for _ in range(count):
        out.append(env.step(env.action_space.sample()))
        if out[-1][2] or out[-1][3]:
            break
    return out


def free_of_constraints(name):
    env = gym.make(
        f"{name}-v5", **({"terminate_when_unhealthy": False} if name in UNHEALTHY else {})
    )
    model = env.unwrapped.model
    model.geom_contype[:], model.geom_conaffinity[:] = 0, 0
    if name == "Humanoid":  # its PGS solver stops early, from a warm start: see docs/gymnasium.md
        model.jnt_limited[:] = 0
    return env


UNHEALTHY = ("Hopper", "Ant", "Humanoid")


@pytest.mark.parametrize(
    "name", ["InvertedPendulum", "Reacher", "HalfCheetah", "Hopper", "Ant", "Humanoid"]
)
def test_with_an_exact_filter_the_observation_is_the_environments_own(name):
    bare, inner = free_of_constraints(name), free_of_constraints(name)
    exact = {k: {**v, "noise": 0.0} for k, v in sensors.default(bare.unwrapped.model).items()}
    env = EstimatedObservation(inner, "ekf", exact, process_noise=0.0, initial_std=0.0)
    assert env.observation_space == bare.observation_space
    for a, b in zip(steps(bare, 25), steps(env, 25)):
        np.testing.assert_allclose(b[0], a[0], rtol=0, atol=1e-9)
        assert b[0].dtype == a[0].dtype


@pytest.mark.parametrize("name", ["InvertedPendulum", "Hopper", "Ant"])
@pytest.mark.parametrize("observe", ["env", "raw"])
def test_the_truth_is_untouched(name, observe):
    bare = gym.make(f"{name}-v5")
    env = wrapped(name, estimator="ekf", observe=observe)
    a, b = steps(bare), steps(env)
    assert len(a) == len(b)
    for x, y in zip(a, b):
        assert x[1:-1] == y[1:-1]
        assert not np.array_equal(x[0], y[0])
        for key in x[-1]:
            np.testing.assert_array_equal(x[-1][key], y[-1][key])
    mine, theirs = bare.unwrapped.data, env.unwrapped.data
    for field in ("qpos", "qvel", "qacc_warmstart", "cfrc_ext", "xpos", "ctrl", "time"):
        np.testing.assert_array_equal(getattr(mine, field), getattr(theirs, field))
    x = np.concatenate([theirs.qpos, theirs.qvel])
    np.testing.assert_array_equal(b[-1][-1]["truth"], x)
    state = [e.unwrapped._np_random.bit_generator.state for e in (bare, env)]
    assert state[0] == state[1]


def test_seeds_reproduce_and_an_unseeded_reset_goes_on():
    def two(env):
        first = steps(env, 3)
        return [s[0] for s in first] + [env.reset()[0]]

    a, b = two(wrapped()), two(wrapped())
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a[0], a[-1])


@pytest.mark.parametrize(
    ("name", "observe", "width"),
    [("InvertedPendulum", "state", 4), ("InvertedPendulum", "belief", 8), ("Ant", "state", 29),
     ("InvertedPendulum", "covariance", 14), ("InvertedPendulum", "raw", 2), ("Ant", "raw", 18)],
)  # fmt: skip
def test_what_is_observed(name, observe, width):
    env = wrapped(name, observe=observe)
    assert env.observation_space.shape == (width,)
    for observation, *_, info in steps(env, 3):
        assert observation in env.observation_space
        if observe == "raw":
            assert set(info) >= {"truth"}
        else:
            np.testing.assert_array_equal(observation[: len(info["estimate"])], info["estimate"])


def test_info():
    env = wrapped(
        sensors={**SLIDE, "gone": {"add": {"type": "jointvel", "object": "hinge"}, "rate": 12.5}}
    )
    out = steps(env, 4)
    for *_, info in out:
        assert info["truth"].shape == info["estimate"].shape == (4,)
        np.testing.assert_allclose(info["error"], info["truth"] - info["estimate"])
        assert isinstance(info["nees"], float)
        assert isinstance(info["nis"], float)
        assert info["diverged"] is False
        assert info["innovation"].shape == (2,)
    assert [o[-1]["nis_dof"] for o in out] == [0, 1, 2, 1, 2]
    assert out[1][-1]["innovation"][1] == 0 != out[2][-1]["innovation"][1]


@pytest.mark.parametrize("name", ["InvertedPendulum", "Swimmer"])
def test_the_filter_is_consistent_where_nothing_touches(name):
    env = wrapped(name, estimator="ekf", process_noise=1e-6)
    n, nees = env._watch.space.n, []
    for seed in range(40):
        nees.append(np.mean([o[-1]["nees"] for o in steps(env, 8, seed)]) / n)
    assert abs(np.mean(nees) - 1) < 4 * np.std(nees) / np.sqrt(40) + 0.05


@pytest.mark.parametrize(
    ("name", "observe"),
    [
        *((name, "env") for name in ROBOTS),
        *((name, observe) for name in ("InvertedPendulum", "Ant") for observe in OTHERS),
    ],
)
def test_check_env(name, observe):
    env = wrapped(name, estimator="ekf", observe=observe)
    with warnings.catch_warnings(record=True) as bare:
        warnings.simplefilter("always")
        check_env(gym.make(f"{name}-v5").unwrapped, skip_render_check=True)
    with warnings.catch_warnings(record=True) as ours:
        warnings.simplefilter("always")
        check_env(env, skip_render_check=True)
    known = {str(w.message) for w in bare}
    new = [str(w.message) for w in ours if str(w.message) not in known]
    # It is a wrapper, as check_env remarks of every wrapper; that is all that is new.
    assert all("different from the unwrapped version" in message for message in new), new


def test_spec_round_trips_through_json():
    env = wrapped(estimator={"type": "ukf", "alpha": 0.5}, sensors=SLIDE, observe="belief")
    text = env.spec.to_json()
    json.loads(text)
    again = gym.make(EnvSpec.from_json(text))
    assert again.spec == env.spec
    for a, b in zip(steps(env, 3), steps(again, 3)):
        np.testing.assert_array_equal(a[0], b[0])


RECORDED = """
import sys
import gymnasium as gym
from gymnasium import wrappers
from estbench.envs import EstimatedObservation

env = EstimatedObservation(gym.make("Reacher-v5", render_mode="rgb_array"), estimator="ekf")
env = wrappers.RecordVideo(wrappers.TimeLimit(env, 5), sys.argv[1], disable_logger=True)
env.reset(seed=0)
while not env.step(env.action_space.sample())[3]:
    pass
env.close()
"""


def test_record_video(tmp_path):
    """In a process of its own: Gymnasium's renderer takes MUJOCO_GL as it is at the start."""
    pytest.importorskip("moviepy")
    bare = RECORDED.replace("EstimatedObservation(", "").replace(', estimator="ekf")', "")
    found = {}
    for name, program in (("bare", bare), ("wrapped", RECORDED)):
        done = subprocess.run(
            [sys.executable, "-c", program, str(tmp_path / name)],
            env={**os.environ, "MUJOCO_GL": "osmesa"},
            capture_output=True,
            text=True,
        )
        found[name] = done
    if found["bare"].returncode:
        pytest.skip("Gymnasium draws nothing here: apt-get install libosmesa6")
    assert not found["wrapped"].returncode, found["wrapped"].stderr[-500:]
    assert len(list((tmp_path / "wrapped").glob("*.mp4"))) == 1


def test_gymnasium_wrappers_compose():
    env = wrapped("Reacher", estimator="ekf")
    env = wrappers.TimeLimit(env, 7)
    env = wrappers.RecordEpisodeStatistics(env)
    env = wrappers.NormalizeObservation(wrappers.FrameStackObservation(env, 2))
    out = steps(env, 30)
    assert len(out) == 8
    assert out[-1][3]
    assert out[-1][0].shape == (2, 10)
    assert out[-1][-1]["episode"]["l"] == 7


def test_parameters_set_on_the_compiled_model_reach_the_filter():
    inner = gym.make("InvertedPendulum-v5")
    inner.unwrapped.model.body_mass[2] *= 3
    inner.unwrapped.model.opt.gravity[2] = -5
    env = EstimatedObservation(inner, "ekf", process_noise=0.0, initial_std=0.0, observe="state")
    assert max(np.abs(o[-1]["error"]).max() for o in steps(env)) < 1e-12
    off = wrapped(
        estimator="ekf", process_noise=0.0, initial_std=0.0, model_set={"body_mass.pole": 9.0}
    )
    assert max(np.abs(o[-1]["error"]).max() for o in steps(off)) > 1e-6
    assert off.unwrapped.model.body_mass[2] != 9


def test_sensors_from_helpers_and_toml(tmp_path):
    path = tmp_path / "sensors.toml"
    path.write_text("""
      [channels.torso_gyro]
      type = "gyro"
      object = "torso"
      object_type = "body"
      noise = [0.1, 0.1, 0.2]
      [channels.knee]
      noise = 0.5
      add = {type = "jointpos", object = "ankle_1"}
      """)
    env = wrapped("Ant", estimator="ekf", observe="raw", sensors=str(path))
    assert env.observation_space.shape == (4,)
    model = env.unwrapped.model
    with pytest.raises(ScenarioError, match=r"'ankel_1' matches no .*did you mean 'ankle_1'"):
        sensors.encoders(model, "ankel_1")
    table = (
        sensors.encoders(model, "ankle_*", 0.02) | sensors.imu("torso", 0.1, 0.5)
        | sensors.position_fix("torso", 0.1, rate=10) | sensors.attitude_fix("torso", 0.1)
    )  # fmt: skip
    env = wrapped("Ant", estimator="ekf", sensors=table)
    assert [c.name for c in env._watch.suite.channels] == list(table)
    dof = [o[-1]["nis_dof"] for o in steps(env, 4)]
    assert dof == [0, 13, 16, 13, 16]
    named = wrapped("Ant", estimator="ekf", sensors=table, observe="raw")
    y = steps(named, 2)[-1][0]
    truth = named.unwrapped.data
    assert np.abs(y[:4] - truth.qpos[8::2]).max() < 0.1
    assert np.abs(y[4:7] - truth.qvel[3:6]).max() < 0.6  # gyro at the torso's origin, body frame
    assert np.abs(y[10:13] - truth.qpos[:3]).max() < 0.5


def test_what_was_assumed_is_said_in_a_line(caplog):
    caplog.set_level(logging.WARNING, "estbench")
    env = wrapped()
    assert len(env.notices) == 1
    assert "using slider_encoder (0.01 m), hinge_encoder (0.01 rad)" in caplog.text
    (line,) = wrapped("Ant").notices
    assert line.endswith(
        "using 8 joint encoders (0.01 rad), torso_position (0.01 m), torso_attitude (0.01 rad), "
        "torso_gyro (0.02 rad/s)"
    )
    caplog.clear()
    assert not wrapped(sensors=SLIDE).notices
    assert not caplog.text


class Plain(gym.Env):
    """A third-party environment: model and data, its own sensors, no MujocoEnv."""

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><body><freejoint/>
          <geom size="0.1"/><site name="s"/></body></worldbody>
          <sensor><framepos name="fix" objtype="site" objname="s" noise="0.05"/>
          <framequat name="compass" objtype="site" objname="s" noise="0.1"/></sensor></mujoco>""")
        self.data = mujoco.MjData(self.model)
        self.observation_space = gym.spaces.Box(-1, 1, (1,))
        self.action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        mujoco.mj_step(self.model, self.data)
        return np.zeros(1, np.float32), 0.0, False, False, {}


def test_a_third_party_environment_with_sensors_of_its_own():
    env = EstimatedObservation(Plain(), observe="state")
    assert not env.notices
    observation, *_, info = steps(env, 5)[-1]
    assert np.abs(observation[:3] - info["truth"][:3]).max() < 0.3
    assert EstimatedObservation(
        Plain(), sensors=["fix"], observe="raw"
    ).observation_space.shape == (3,)
    added = {"a": {"type": "framepos", "object": "s", "noise": 0.1}}  # no MJCF is needed
    assert EstimatedObservation(Plain(), sensors=added, observe="raw")._watch.suite.space.nx == 3
    with pytest.raises(EnvError, match=r"observe='env' needs Plain._get_obs.*observe='state'"):
        EstimatedObservation(Plain(), observe="env")
    by_default = EstimatedObservation(Plain())
    assert by_default.observation_space.shape == (13,)
    assert by_default.notices[-1].startswith("observing the estimated state: observe='env' needs")


def test_only_mujoco_environments():
    with pytest.raises(EnvError, match=r"CartPoleEnv is not a MuJoCo environment.*Scenario-v0"):
        EstimatedObservation(gym.make("CartPole-v1"))


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        ({"sensors": ["gyro"]}, ScenarioError, "no sensor 'gyro'"),
        ({"sensors": []}, ScenarioError, "sensors is empty"),
        ({"sensors": {"a": {"type": "jointpos", "object": "slidr"}}}, ScenarioError,
         r"sensors\.a\.object: the model has no joint 'slidr' .did you mean 'slider'"),
        ({"sensors": {"a": {"type": "jointposs", "object": "slider"}}}, ScenarioError,
         "no sensor type 'jointposs' .did you mean 'jointpos'"),
        ({"sensors": {"a": {"nose": 1, "rate": -1}}}, ScenarioError,
         "sensors.a.rate: .*sensors.a.nose: unknown key .did you mean 'noise'"),
        ({"sensors": "no.toml"}, ScenarioError, "sensors 'no.toml' cannot be read"),
        ({"sensors": {"a": {**SLIDE["slider_encoder"], "rate": 50}}}, ScenarioError,
         r"sensors.a.rate: a reading every 1 physics steps, .* falls inside a step"),
        ({"sensors": {"a": {**SLIDE["slider_encoder"], "noise": -1}}}, CovarianceError,
         "noise is -1"),
        ({"estimator": "ukff"}, EstimatorError, "no estimator 'ukff' .did you mean 'ukf'"),
        ({"estimator": {"alpha": 1}}, EnvError, "a table needs a type"),
        ({"estimator": "filterpy_ukf", "initial_std": 0.0}, EstimatorError,
         "UKF: initial_std is 0 for slider.*use 'ekf'"),
        ({"initial_std": -1}, CovarianceError, "initial_std is -1"),
        ({"initial_std": [1, 2]}, DimensionError, "initial_std has 2 values; expected 1 or 4"),
        ({"initial_std": {"slidr": 1}}, ScenarioError, "initial_std: 'slidr' matches none"),
        ({"process_noise": -1}, CovarianceError, "process_noise.density is negative"),
        ({"process_noise": {"kind": "forse"}}, EnvError, "kind is 'forse' .did you mean 'force'"),
        ({"observe": "estimate"}, EnvError, "observe is 'estimate'"),
        ({"model_set": {"body_mas.pole": 1}}, ScenarioError,
         "model_set: no model field 'body_mas'"),
    ],
)  # fmt: skip
def test_bad_arguments(kwargs, error, message):
    with pytest.raises(error, match=message):
        wrapped(**kwargs)


def test_a_changed_observation_cannot_be_computed_at_the_estimate():
    inner = wrappers.FlattenObservation(wrappers.FrameStackObservation(gym.make("Hopper-v5"), 2))
    with pytest.raises(
        EnvError, match=r"a wrapper between has changed it; put EstimatedObservation"
    ):
        EstimatedObservation(inner, observe="env")


def test_a_step_after_the_end_and_actions_outside():
    env = wrapped(estimator="ekf")
    with pytest.raises(EnvError, match=r"before the first; call reset"):
        env.step(np.zeros(1, np.float32))
    steps(env, 1000)
    with pytest.raises(EnvError, match=r"step\(\) after the end of an episode"):
        env.step(np.zeros(1, np.float32))
    env.reset()
    with pytest.raises(EnvError, match=r"action\[0\] is nan; use a finite number"):
        env.step(np.full(1, np.nan, np.float32))
    with pytest.raises(EnvError, match=r"action has shape \(2,\); expected \(1,\)"):
        env.step(np.zeros(2, np.float32))
    env.step(np.full(1, 3, np.float32))


def test_mujocos_global_settings_are_put_back():
    from estbench.robots import library

    gc.collect()  # the environments of other tests
    before = library._users
    envs = [wrapped(estimator="ekf"), gym.make("estbench/Pendulum-v0")]
    assert library._users >= before + 2
    for env in envs:
        env.close()
        env.close()
    gc.collect()
    assert library._users == before


def test_wrapped_environments_in_other_processes():
    env = gym.make_vec(
        "InvertedPendulum-v5", 2, vectorization_mode="async",
        wrappers=[lambda e: EstimatedObservation(e, "ekf", SLIDE)],
    )  # fmt: skip
    try:
        observations, infos = env.reset(seed=0)
        np.testing.assert_array_equal(
            observations[1], wrapped(estimator="ekf", sensors=SLIDE).reset(seed=1)[0]
        )
        assert infos["estimate"].shape == (2, 4)
        env.step(env.action_space.sample())
    finally:
        env.close()


@pytest.mark.parametrize("steps_before", [0, 3])
def test_a_reset_by_mujoco_is_seen_in_the_first_step_as_in_any_other(steps_before):
    env = wrapped(estimator="ekf")
    env.reset(seed=0)
    for _ in range(steps_before):
        env.step(np.zeros(1, np.float32))
    env.unwrapped.data.qvel[:] = 1e12
    with pytest.raises(EnvError, match="MuJoCo reset the state"):
        env.step(np.zeros(1, np.float32))


@pytest.mark.parametrize("nthread", [0, 1.5, True, "2"])
def test_a_wrong_number_of_threads_is_named(nthread):
    with pytest.raises(EnvError, match=r"nthread is .*; use a whole number of at least 1"):
        EstimatedObservation(gym.make("InvertedPendulum-v5"), nthread=nthread)
    with pytest.raises(EnvError, match="nthread is "):
        gym.make("estbench/Pendulum-v0", nthread=nthread)


def test_the_estimates_do_not_depend_on_the_threads():
    name, rng = "HalfCheetah-v5", np.random.default_rng(0)
    envs = [EstimatedObservation(gym.make(name), "ekf", nthread=n) for n in (None, 1, 2)]
    starts = [env.reset(seed=0)[0] for env in envs]
    for _ in range(2 * sharing.CALLS + 5):  # a whole trial
        action = rng.uniform(-1, 1, 6).astype(np.float32)
        seen = [env.step(action)[0] for env in envs]
        assert all((a == seen[0]).all() for a in seen)
    assert all((a == starts[0]).all() for a in starts)
