# pyright: reportOptionalMemberAccess=false, reportArgumentType=false
# pyright: reportOptionalSubscript=false, reportGeneralTypeIssues=false
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest

from estbench.envs import EnvError, EstimatedObservation
from estbench.errors import MissingExtraError


def test_without_stable_baselines3_the_extra_is_named(monkeypatch):
    monkeypatch.delitem(sys.modules, "estbench.envs.sb3", raising=False)
    for name in [m for m in sys.modules if m.split(".")[0] == "stable_baselines3"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'estbench\[sb3\]'"):
        import estbench.envs.sb3  # noqa: F401


sb3 = pytest.importorskip("stable_baselines3", reason="the extra 'sb3' is not installed")


def make(num_envs=4, **kwargs):
    from estbench.envs.sb3 import BatchVecEnv

    return BatchVecEnv("estbench/CartPole-v0", num_envs, **kwargs)


@pytest.mark.parametrize("name", ["Pendulum", "CartPole", "Acrobot", "Quadrotor"])
@pytest.mark.parametrize("observe", ["state", "raw"])
def test_check_env(name, observe):
    from stable_baselines3.common.env_checker import check_env

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(f"estbench/{name}-v0", observe=observe).unwrapped)


@pytest.mark.parametrize("observe", ["env", "belief"])
def test_check_env_of_a_wrapped_environment(observe):
    from stable_baselines3.common.env_checker import check_env

    bare, ours = [], []
    for env, found in (
        (gym.make("InvertedPendulum-v5"), bare),
        (EstimatedObservation(gym.make("InvertedPendulum-v5"), "ekf", observe=observe), ours),
    ):
        with warnings.catch_warnings(record=True) as seen:
            warnings.simplefilter("always")
            check_env(env)
        found += [str(w.message) for w in seen]
    assert set(ours) <= set(bare)


def test_it_is_the_vector_environment():
    env, plain = make(), gym.make_vec("estbench/CartPole-v0", 4, autoreset_mode="SameStep")
    env.seed(7)
    np.testing.assert_array_equal(env.reset(), plain.reset(seed=7)[0])
    rng, ends = np.random.default_rng(0), 0
    for _ in range(90):
        actions = rng.uniform(-1, 1, (4, 1)).astype(np.float32)
        a, b = env.step(actions), plain.step(actions)
        np.testing.assert_array_equal(a[0], b[0])
        np.testing.assert_array_equal(a[1], b[1])
        np.testing.assert_array_equal(a[2], b[2] | b[3])
        for row in np.flatnonzero(a[2]):
            ends += 1
            final = a[3][row]["terminal_observation"]
            np.testing.assert_array_equal(final, b[-1]["final_obs"][row])
            assert a[3][row]["TimeLimit.truncated"] is False
    assert ends > 2
    assert env.get_attr("render_mode", [0, 1]) == [None, None]
    assert env.env_is_wrapped(gym.Wrapper) == [False] * 4
    env.close()


def test_time_limits_and_infos():
    env = make(2, infos=True, max_episode_steps=3)
    env.reset()
    for _ in range(3):
        _, _, over, infos = env.step(np.zeros((2, 1)))
        assert infos[1]["truth"].shape == (4,)
    assert over.all()
    assert infos[0]["TimeLimit.truncated"] is True


def test_ppo_takes_it():
    env = make(8)
    model = sb3.PPO("MlpPolicy", env, n_steps=16, batch_size=64, n_epochs=1, device="cpu", seed=0)
    model.learn(256)
    action, _ = model.predict(env.reset(), deterministic=True)
    assert action.shape == (8, 1)


def test_bad_input():
    from estbench.envs.sb3 import BatchVecEnv

    with pytest.raises(EnvError, match=r"autoreset_mode is 'NextStep'.*SameStep"):
        BatchVecEnv(gym.make_vec("estbench/CartPole-v0", 2))
    with pytest.raises(EnvError, match=r"SyncVectorEnv is not estbench's vector environment"):
        BatchVecEnv(gym.make_vec("CartPole-v1", 2, vectorization_mode="sync"))
    with pytest.raises(EnvError, match=r"set_attr\('x'\) of some rows"):
        make().set_attr("x", 1, [0])
