# pyright: reportOptionalMemberAccess=false, reportArgumentType=false
# pyright: reportOptionalSubscript=false, reportGeneralTypeIssues=false
import json
import pickle
import subprocess
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

import estbench.envs  # noqa: F401
from estbench.envs.errors import EnvError
from estbench.errors import EstbenchError, EstimatorError, ScenarioError

IDS = ["Pendulum", "CartPole", "Acrobot", "Quadrotor"]
OBSERVE = ["state", "belief", "covariance", "raw", "truth"]


def make(name="CartPole", **kwargs):
    return gym.make(f"estbench/{name}-v0", **kwargs)


def rollout(env, seed=3, steps=40, scale=0.2):
    env.action_space.seed(seed)
    observation, info = env.reset(seed=seed)
    out = [(observation, 0.0, False, False, info)]
    for _ in range(steps):
        out.append(env.step(scale * env.action_space.sample()))
        if out[-1][2] or out[-1][3]:
            break
    return out


@pytest.mark.parametrize("name", IDS)
def test_check_env_has_nothing_to_say(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make(name).unwrapped, skip_render_check=True)


@pytest.mark.parametrize("observe", OBSERVE)
def test_check_env_for_every_observation(observe):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make("Acrobot", observe=observe).unwrapped, skip_render_check=True)


def test_seeds_reproduce_and_differ():
    a, b, c = (rollout(make("Quadrotor"), seed) for seed in (3, 3, 4))
    for x, y in zip(a, b):
        np.testing.assert_array_equal(x[0], y[0])
        assert x[1] == y[1]
    assert not np.array_equal(a[0][0], c[0][0]) or not np.array_equal(a[1][0], c[1][0])


def test_an_episode_after_another_is_a_new_one_and_reproducible():
    def second(env):
        rollout(env, 3, 5)
        env.reset()
        return env.step(env.action_space.sample())[4]["truth"]

    first = rollout(make(), 3, 1)[0][4]["truth"]
    np.testing.assert_array_equal(second(make()), second(make()))
    assert not np.array_equal(first, second(make()))


def test_the_truth_does_not_depend_on_filter_sensors_or_observation():
    plain = rollout(make(estimator=None, observe="truth"))
    for kwargs in (
        {"estimator": "ukf"}, {"observe": "raw"}, {"sensors": ["cart_encoder"]},
        {"estimator": {"type": "ukf", "alpha": 0.3}},
        {"overrides": ["filter.process_noise_scale=9"]},
    ):  # fmt: skip
        other = rollout(make(**kwargs))
        assert len(other) == len(plain)
        for a, b in zip(plain, other):
            np.testing.assert_array_equal(a[4]["truth"], b[4]["truth"])
            assert a[1:4] == b[1:4]


@pytest.mark.parametrize(
    ("observe", "width"),
    [("state", 13), ("belief", 25), ("covariance", 91), ("raw", 13), ("truth", 13)],
)
def test_what_is_observed(observe, width):
    env = make("Quadrotor", observe=observe)
    assert env.observation_space.shape == (width,)
    for observation, *_, info in rollout(env, steps=3):
        assert observation in env.observation_space
        bank = env.unwrapped.world.filter
        if observe == "truth":
            np.testing.assert_array_equal(observation, info["truth"])
        elif observe != "raw":
            np.testing.assert_array_equal(observation[:13], info["estimate"])
    if observe == "belief":
        np.testing.assert_allclose(observation[13:] ** 2, np.diag(bank.cov[0]))
    if observe == "covariance":
        upper = np.zeros((12, 12))
        upper[np.triu_indices(12)] = observation[13:]
        np.testing.assert_array_equal(upper, np.triu(bank.cov[0]))
    if observe == "raw":  # accel, gyro, position, attitude
        assert abs(np.linalg.norm(observation[9:]) - 1) < 1e-12
        assert 0 < np.linalg.norm(observation[6:9] - info["truth"][:3]) < 0.4


def test_actions_span_the_range_of_the_actuators():
    env, raw = make("Quadrotor"), make("Quadrotor", normalize_actions=False)
    assert (env.action_space.low == -1).all()
    assert (raw.action_space.high == 6).all()
    ends = []
    for e, action in ((env, [-1, 0, 0.5, 1]), (raw, [0, 3, 4.5, 6])):
        e.reset(seed=0)
        ends.append(e.step(np.array(action, np.float32))[4]["truth"])
        np.testing.assert_allclose(e.unwrapped.world.u, [[0, 3, 4.5, 6]])
        actions = e.unwrapped._actions
        np.testing.assert_allclose(actions.actions(np.array([0, 3, 4.5, 6])), action)
    np.testing.assert_array_equal(*ends)


def test_the_end_of_an_episode():
    env = make(overrides=["task.horizon=0.05"])
    env.reset(seed=0)
    flags = [env.step(np.zeros(1, np.float32))[2:4] for _ in range(5)]
    assert flags == [(False, False)] * 4 + [(False, True)]
    with pytest.raises(EnvError, match=r"step\(\) after the end of an episode.*call reset"):
        env.step(np.zeros(1, np.float32))
    env.reset()
    env.step(np.zeros(1, np.float32))
    env = make()
    out = rollout(env, steps=500, scale=1.0)
    assert out[-1][2]
    assert abs(out[-1][4]["truth"][1]) > 0.6 or abs(out[-1][4]["truth"][0]) > 2
    assert out[-1][1] <= 0 < out[-2][1]


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (
            np.array([1.5]),
            r"action\[0\] \(force\) is 1.5; expected a value in \[-1, 1\].*ClipAction",
        ),
        (np.array([np.nan]), r"is nan; use a finite number"),
        (np.zeros(2), r"action has shape \(2,\); expected \(1,\)"),
    ],
)
def test_bad_actions(action, message):
    env = make().unwrapped
    env.reset(seed=0)
    with pytest.raises(EnvError, match=message):
        env.step(action)


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        ({"scenario": None}, EnvError, "scenario is missing"),
        ({"scenario": "cartpoll"}, ScenarioError, "no scenario 'cartpoll' .did you mean"),
        ({"estimator": "efk"}, EstimatorError, "no estimator 'efk' .did you mean 'ekf'"),
        ({"estimator": {"alpha": 1}}, EnvError, "a table needs a type"),
        ({"estimator": {"type": "ukf", "alpha": 7}}, EstimatorError, "alpha is 7"),
        ({"observe": "believe"}, EnvError, "observe is 'believe' .did you mean 'belief'"),
        ({"estimator": None}, EnvError, "observe='state' needs a filter"),
        ({"sensors": ["pole"]}, ScenarioError, "no sensor 'pole' .*pole_encoder"),
        ({"overrides": ["task.x=1"]}, ScenarioError, "task.x: unknown key"),
        ({"sensors": []}, ScenarioError, "no sensor"),
    ],
)
def test_bad_arguments(kwargs, error, message):
    with pytest.raises(error, match=message):
        make("Scenario", **{"scenario": "cartpole", **kwargs})
    assert issubclass(EnvError, EstbenchError)


def test_spec_round_trips_through_json():
    env = make("Quadrotor", estimator={"type": "ukf", "alpha": 0.5}, observe="belief")
    text = env.spec.to_json()
    json.loads(text)
    again = gym.make(EnvSpec.from_json(text))
    assert again.spec == env.spec
    for a, b in zip(rollout(env, steps=3), rollout(again, steps=3)):
        np.testing.assert_array_equal(a[0], b[0])
    assert pickle.loads(pickle.dumps(env.spec)) == env.spec


def test_a_users_own_robot(tmp_path):
    (tmp_path / "slider.xml").write_text("""<mujoco><option timestep="0.02"/><worldbody><body>
      <joint name="x" type="slide" axis="1 0 0"/><geom type="sphere" size="0.1" mass="1"/>
      </body></worldbody>
      <actuator><motor name="free" joint="x"/></actuator>
      <sensor><jointpos name="ruler" joint="x" noise="0.01"/></sensor></mujoco>""")
    (tmp_path / "slider.toml").write_text("""name = "slider"
      process_noise.density = {"*.vel" = 0.01}
      task.bounds = {"x" = 3.0}
      [model]
      path = "slider.xml"
      """)
    for path in ("slider.toml", "slider.xml"):
        env = make("Scenario", scenario=str(tmp_path / path))
        assert env.action_space.high[0] == 1e10  # no ctrlrange: in its own unit
        env.reset(seed=0)
        x = env.step(np.full(1, 50, np.float32))[4]["truth"]
        assert abs(x[1] - 1.0) < 0.5


def test_a_truth_that_blows_up_ends_the_episode():
    env = make("Scenario", scenario="cartpole", normalize_actions=False).unwrapped
    env.reset(seed=0)
    env.world.simulator.x[:] = np.nan
    observation, reward, ended, _, info = env.step(np.zeros(1, np.float32))
    assert ended
    assert reward == 0.0
    assert np.isfinite(observation).all()
    assert info["nees"] == np.inf


def test_gymnasium_wrappers_compose():
    from gymnasium import wrappers

    env = make("Pendulum", max_episode_steps=20)
    env = wrappers.RecordEpisodeStatistics(env)
    env = wrappers.NormalizeObservation(wrappers.FrameStackObservation(env, 3))
    out = rollout(env, steps=30)
    assert len(out) == 21
    assert out[-1][3]
    assert out[-1][0].shape == (3, 2)
    assert out[-1][4]["episode"]["l"] == 20


def test_an_id_that_needs_no_import_reaches_a_fresh_process():
    """What a worker of SubprocVecEnv does: it unpickles the id and calls `gym.make`."""
    code = (
        "import gymnasium as gym\n"
        "print(gym.make('estbench.envs:estbench/Pendulum-v0').reset(seed=0)[0].shape)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == "(2,)\n", done.stderr[-2000:]
