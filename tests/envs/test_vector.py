# pyright: reportOptionalMemberAccess=false, reportArgumentType=false
# pyright: reportOptionalSubscript=false, reportGeneralTypeIssues=false
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import estbench.envs  # noqa: F401
from estbench.envs.errors import EnvError

NAMES = ["Pendulum", "CartPole", "Acrobot", "Quadrotor"]
IMPERFECT = [
    "channels.pole_encoder.bias=0.02", "channels.pole_encoder.bias_walk=0.01",
    "channels.pole_encoder.dropout=0.3", "channels.pole_encoder.dropout_length=3",
    "channels.cart_encoder.outlier_probability=0.1", "channels.cart_encoder.stuck=0.1",
    "channels.cart_encoder.quantization=0.01", "channels.cart_encoder.rate=50",
    "channels.cart_encoder.latency=0.035", "channels.cart_encoder.latency_std=0.01",
    'truth.draw={"body_mass.pole" = {relative_std = 0.2}}',
]  # fmt: skip
FIELDS = (
    "truth",
    "estimate",
    "error",
    "nees",
    "nees_dof",
    "nis",
    "nis_dof",
    "innovation",
    "diverged",
)


def pair(name="CartPole", rows=5, mode="NextStep", **kwargs):
    """The native vector and as many scalar environments stepped by Gymnasium."""
    vector = gym.make_vec(f"estbench/{name}-v0", rows, autoreset_mode=mode, **kwargs)
    scalar = gym.make_vec(
        f"estbench/{name}-v0", rows, vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": AutoresetMode(mode)}, **kwargs,
    )  # fmt: skip
    return vector, scalar


def assert_same(a, b):
    """Truth, rewards and ends to the last bit, estimates to rounding."""
    for x, y in zip(a[1:-1], b[1:-1]):
        np.testing.assert_array_equal(x, y)
    np.testing.assert_allclose(a[0], b[0], rtol=0, atol=1e-9)
    assert set(a[-1]) == set(b[-1])
    for key in FIELDS:
        there = a[-1][f"_{key}"]
        np.testing.assert_array_equal(there, b[-1][f"_{key}"])
        exact = key in ("truth", "nis_dof", "diverged")
        np.testing.assert_allclose(
            a[-1][key][there],
            b[-1][key][there],
            rtol=0 if exact else 1e-6,
            atol=0 if exact else 1e-9,
        )


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize(
    ("name", "kwargs"),
    [
        ("CartPole", {}),
        ("CartPole", {"observe": "belief", "estimator": "ukf"}),
        ("CartPole", {"observe": "raw", "overrides": IMPERFECT}),
        ("CartPole", {"overrides": [*IMPERFECT, "model.frame_skip=3"]}),
        ("Quadrotor", {"overrides": ["task.horizon=0.1", "channels.position.rate=20"]}),
        ("Acrobot", {"overrides": ["task.horizon=0.2"], "observe": "covariance"}),
    ],
)
def test_rows_are_the_scalar_environments(name, kwargs, mode):
    vector, scalar = pair(name, mode=mode, **kwargs)
    assert vector.single_observation_space == scalar.single_observation_space
    assert vector.single_action_space == scalar.single_action_space
    assert vector.observation_space == scalar.observation_space
    assert_same((*vector.reset(seed=3),), (*scalar.reset(seed=3),))
    vector.action_space.seed(0)
    ends = 0
    for _ in range(70):
        actions = vector.action_space.sample()
        a, b = vector.step(actions), scalar.step(actions)
        assert_same(a, b)
        assert a[0] in vector.observation_space
        ends += (a[2] | a[3]).sum()
        if "final_obs" in a[-1]:
            over = a[-1]["_final_obs"]
            np.testing.assert_array_equal(over, a[2] | a[3])
            for row in np.flatnonzero(over):
                final = a[-1]["final_obs"][row], b[-1]["final_obs"][row]
                np.testing.assert_allclose(*final, rtol=0, atol=1e-9)
            assert_same((a[0], a[-1]["final_info"]), (a[0], {**b[-1]["final_info"]}))
    assert ends > 3


def test_disabled_autoreset_and_partial_resets():
    vector, scalar = pair(mode="Disabled")
    assert_same((*vector.reset(seed=1),), (*scalar.reset(seed=1),))
    vector.action_space.seed(1)
    resets = 0
    for _ in range(120):
        actions = vector.action_space.sample()
        a, b = vector.step(actions), scalar.step(actions)
        assert_same(a, b)
        over = a[2] | a[3]
        if over.any():
            if not resets:
                with pytest.raises(EnvError, match=r"episode of row \d; call .*reset_mask"):
                    vector.step(actions)
            resets += 1
            seeds = [int(s) for s in range(10 * resets, 10 * resets + 5)] if resets % 2 else None
            a, b = (
                e.reset(seed=seeds, options={"reset_mask": over.copy()}) for e in (vector, scalar)
            )
            np.testing.assert_allclose(a[0], b[0], rtol=0, atol=1e-9)
            np.testing.assert_array_equal(a[1]["_truth"], over)
            np.testing.assert_array_equal(a[1]["truth"][over], b[1]["truth"][over])
    assert resets > 2


def test_partial_reset_restarts_the_filter_of_these_rows_only():
    vector = gym.make_vec("estbench/CartPole-v0", 4)
    vector.reset(seed=0)
    for _ in range(3):
        vector.step(np.zeros((4, 1)))
    bank, world = vector.world.filter, vector.world
    before = bank.estimate.copy(), bank.cov.copy(), world.x.copy()
    mask = np.array([False, True, False, True])
    vector.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(bank.cov[mask], np.repeat(world.setup.cov[None], 2, axis=0))
    np.testing.assert_array_equal(bank.estimate[mask], np.repeat(world.setup.mean[None], 2, axis=0))
    for now, then in zip((bank.estimate, bank.cov, world.x), before):
        np.testing.assert_array_equal(now[~mask], then[~mask])
    assert world.elapsed.tolist() == [3, 0, 3, 0]


@pytest.mark.parametrize("threads", [1, 2])
def test_threads_do_not_matter(threads):
    vector = gym.make_vec("estbench/Quadrotor-v0", 20, nthread=threads)
    other = gym.make_vec("estbench/Quadrotor-v0", 20, nthread=1)
    for env in (vector, other):
        env.reset(seed=0)
    for _ in range(10):
        a, b = (env.step(np.full((20, 4), -0.18)) for env in (vector, other))
        np.testing.assert_array_equal(a[0], b[0])


def test_observations_and_infos_are_new_every_time():
    vector = gym.make_vec("estbench/CartPole-v0", 3)
    kept = [vector.reset(seed=0)]
    copies = [(kept[0][0].copy(), kept[0][1]["truth"].copy())]
    for _ in range(3):
        observation, *_, info = vector.step(np.ones((3, 1)))
        kept.append((observation, info))
        copies.append((observation.copy(), info["truth"].copy()))
    for (observation, info), (first, truth) in zip(kept, copies):
        np.testing.assert_array_equal(observation, first)
        np.testing.assert_array_equal(info["truth"], truth)


def test_spec_metadata_and_max_episode_steps():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        vector = gym.make_vec("estbench/Pendulum-v0", 2, max_episode_steps=4, estimator="ukf")
    assert vector.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert vector.metadata["render_fps"] == 100
    again = gym.make_vec(type(vector.spec).from_json(vector.spec.to_json()))
    assert again.num_envs == 2
    assert not isinstance(again, SyncVectorEnv)
    for env in (vector, again):
        env.reset(seed=0)
        late = [env.step(np.zeros((2, 1)))[3].tolist() for _ in range(6)]
        assert late == [[False] * 2] * 3 + [[True] * 2] + [[False] * 2] * 2


def test_gymnasiums_vector_wrappers():
    from gymnasium.wrappers import vector as wrappers

    env = wrappers.RecordEpisodeStatistics(gym.make_vec("estbench/CartPole-v0", 6))
    env = wrappers.DictInfoToList(wrappers.NormalizeObservation(env))
    env.reset(seed=0)
    env.action_space.seed(0)
    lengths = []
    for _ in range(80):
        *_, infos = env.step(env.action_space.sample())
        lengths += [i["episode"]["l"] for i in infos if "episode" in i]
        assert len(infos) == 6
        assert infos[0]["truth"].shape == (4,)
    assert len(lengths) > 4


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"num_envs": 0}, "num_envs is 0"),
        ({"autoreset_mode": "Never"}, "autoreset_mode is 'Never'; use one of NextStep"),
        ({"render_mode": "human"}, "render_mode is 'human'; a vector has 'rgb_array'"),
        ({"max_episode_steps": 0}, "max_episode_steps is 0"),
        ({"estimator": None}, "observe='state' needs a filter"),
    ],
)
def test_bad_arguments(kwargs, message):
    with pytest.raises(EnvError, match=message):
        gym.make_vec("estbench/CartPole-v0", **{"num_envs": 2, **kwargs})


def test_bad_calls():
    env = gym.make_vec("estbench/CartPole-v0", 2)
    with pytest.raises(EnvError, match=r"before the first; call reset"):
        env.step(np.zeros((2, 1)))
    with pytest.raises(EnvError, match=r"reset all rows first"):
        env.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(EnvError, match=r"seed has 3 values; expected one per row, 2"):
        env.reset(seed=[1, 2, 3])
    env.reset(seed=[4, None])
    for mask, message in (
        ([True, False], r"reset_mask is \[True, False\]; expected a numpy array of 2"),
        (np.zeros(2, int), "reset_mask is int64"),
        (np.zeros(3, bool), r"reset_mask is bool \(3,\)"),
        (np.zeros(2, bool), "False everywhere"),
    ):
        with pytest.raises(EnvError, match=message):
            env.reset(options={"reset_mask": mask})
    with pytest.raises(EnvError, match=r"action\[1, 0\] \(force\) is 2"):
        env.step(np.array([[0.0], [2.0]]))
    with pytest.raises(EnvError, match=r"action has shape \(1, 1\); expected \(2, 1\)"):
        env.step(np.zeros((1, 1)))


def test_an_estimator_that_uses_the_time_sees_the_clock_of_its_row():
    """The LKF of a row that begins anew is handed over at a time of that row's episode."""
    lkf = {"type": "lkf", "handover_time": 0.1}
    kwargs = {"estimator": lkf, "overrides": ["initial.std={'*'=0.5}"]}
    vector = gym.make_vec("estbench/Pendulum-v0", 2, autoreset_mode="Disabled", **kwargs)
    scalar = gym.make("estbench/Pendulum-v0", **kwargs)
    vector.reset(seed=[3, 4])
    u = np.full((2, 1), 0.2, np.float32)
    for _ in range(15):
        vector.step(u)
    vector.reset(seed=[None, 9], options={"reset_mask": np.array([False, True])})
    scalar.reset(seed=9)
    for _ in range(20):
        info, own = vector.step(u)[-1], scalar.step(u[0])[-1]
        np.testing.assert_allclose(info["estimate"][1], own["estimate"], rtol=1e-9, atol=1e-9)
