# pyright: reportOptionalMemberAccess=false, reportArgumentType=false
# pyright: reportOptionalSubscript=false, reportGeneralTypeIssues=false
import logging

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from estbench.envs import EnvError, EstimatedObservation, RecordTruth, VectorEstimatedObservation

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


@pytest.fixture(autouse=True)
def _quiet(caplog):
    caplog.set_level(logging.ERROR, "estbench")


def vector(name="InvertedPendulum", rows=3, how="sync", mode="NextStep", record=False, **kwargs):
    env = gym.make_vec(
        f"{name}-v5", rows, vectorization_mode=how, wrappers=[RecordTruth] if record else None,
        vector_kwargs={"autoreset_mode": AutoresetMode(mode)},
    )  # fmt: skip
    return VectorEstimatedObservation(env, **{"estimator": "ekf", **kwargs})


def scalars(name="InvertedPendulum", rows=3, mode="NextStep", **kwargs):
    return gym.make_vec(
        f"{name}-v5", rows, vectorization_mode="sync",
        wrappers=[lambda e: EstimatedObservation(e, **{"estimator": "ekf", **kwargs})],
        vector_kwargs={"autoreset_mode": AutoresetMode(mode)},
    )  # fmt: skip


def assert_same(a, b, atol=1e-8):
    for x, y in zip(a[1:-1], b[1:-1]):
        np.testing.assert_array_equal(x, y)
    np.testing.assert_allclose(a[0], b[0], rtol=0, atol=atol)
    assert {k for k in a[-1] if k != "_final_info"} == {k for k in b[-1] if k != "_final_info"}
    for key in FIELDS:
        if key in b[-1]:
            there = b[-1][f"_{key}"]
            np.testing.assert_array_equal(a[-1][f"_{key}"], there)
            np.testing.assert_allclose(
                a[-1][key][there], b[-1][key][there], rtol=1e-5, atol=0 if key == "truth" else atol
            )


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
@pytest.mark.parametrize("observe", ["env", "belief", "raw"])
@pytest.mark.parametrize("record", [False, True])
def test_rows_are_the_scalar_wrappers(mode, observe, record):
    if mode == "SameStep" and not record:
        pytest.skip("needs RecordTruth")
    a, b = vector(mode=mode, observe=observe, record=record), scalars(mode=mode, observe=observe)
    assert a.observation_space == b.observation_space
    assert a.single_observation_space == b.single_observation_space
    assert_same((*a.reset(seed=5),), (*b.reset(seed=5),))
    a.action_space.seed(0)
    ends = 0
    for _ in range(25):
        actions = a.action_space.sample()
        x, y = a.step(actions), b.step(actions)
        assert_same(x, y)
        over = x[2] | x[3]
        ends += over.sum()
        if mode == "SameStep" and over.any():
            for row in np.flatnonzero(over):
                final = x[-1]["final_obs"][row], y[-1]["final_obs"][row]
                np.testing.assert_allclose(*final, atol=1e-8)
            assert_same((x[0], x[-1]["final_info"]), (y[0], y[-1]["final_info"]))
        if mode == "Disabled" and over.any():
            with pytest.raises(EnvError, match=r"after the end of the episode of row"):
                a.step(actions)
            options = [{"reset_mask": over.copy()} for _ in range(2)]
            assert_same((*a.reset(options=options[0]),), (*b.reset(options=options[1]),))
    assert ends > 4


@pytest.mark.parametrize("record", [False, True])
def test_other_processes(record):
    a = vector(how="async", record=record, rows=2)
    b = scalars(rows=2)
    try:
        assert_same((*a.reset(seed=5),), (*b.reset(seed=5),))
        for _ in range(8):
            actions = a.action_space.sample()
            assert_same(a.step(actions), b.step(actions))
    finally:
        a.close()


def test_contacts_and_quaternions():
    kwargs = {"observe": "env", "sensors": None}
    a, b = vector("Ant", 2, **kwargs), scalars("Ant", 2, **kwargs)
    assert_same((*a.reset(seed=1),), (*b.reset(seed=1),))
    for _ in range(6):
        actions = 0.3 * a.action_space.sample()
        assert_same(a.step(actions), b.step(actions), atol=1e-6)


def test_gymnasiums_vector_wrappers():
    from gymnasium.wrappers import vector as wrappers

    env = wrappers.RecordEpisodeStatistics(vector(observe="state"))
    env = wrappers.NormalizeObservation(env)
    env.reset(seed=0)
    lengths = []
    for _ in range(30):
        *_, info = env.step(env.action_space.sample())
        if "episode" in info:
            lengths += info["episode"]["l"][info["_episode"]].tolist()
    assert len(lengths) > 3


def test_bad_input():
    with pytest.raises(EnvError, match=r"neither SyncVectorEnv nor AsyncVectorEnv"):
        VectorEstimatedObservation(gym.make_vec("CartPole-v1", 2))
    with pytest.raises(EnvError, match=r"CartPoleEnv is not a MuJoCo environment"):
        VectorEstimatedObservation(gym.make_vec("CartPole-v1", 2, vectorization_mode="sync"))
    env = vector(mode="SameStep", rows=2)
    env.reset(seed=0)
    with pytest.raises(
        EnvError, match=r"same-step autoreset.*wrappers=\[estbench.envs.RecordTruth\]"
    ):
        [env.step(np.ones((2, 1))) for _ in range(100)]
    with pytest.raises(EnvError, match=r"action\[1, 0\] is inf; use a finite number"):
        env.step(np.array([[0.0], [np.inf]]))


def test_a_function_of_the_time_sees_the_clock_of_its_row(tmp_path, monkeypatch):
    """Also in the filter's model, in a row that begins anew while the other goes on."""
    text = (
        "import numpy as np\n\n\ndef wave(x, u, t):\n    return x[..., :1] * (1 + np.sin(5 * t))\n"
    )
    (tmp_path / "wave_of_time.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    sensors = {
        "encoder": {"type": "jointpos", "object": "joint0", "noise": 0.01},
        "wave": {"function": "wave_of_time:wave", "unit": "m", "noise": 0.01},
    }
    kwargs = {"estimator": "ekf", "sensors": sensors, "observe": "state"}
    disabled = {"autoreset_mode": gym.vector.AutoresetMode.DISABLED}
    inner = gym.make_vec("Reacher-v5", 2, vectorization_mode="sync", vector_kwargs=disabled)
    vector = VectorEstimatedObservation(inner, **kwargs)
    scalar = EstimatedObservation(gym.make("Reacher-v5"), **kwargs)
    vector.reset(seed=[1, 2])
    actions = np.full((2, 2), 0.1, np.float32)
    for _ in range(10):
        vector.step(actions)
    vector.reset(seed=[None, 9], options={"reset_mask": np.array([False, True])})
    scalar.reset(seed=9)
    for _ in range(5):
        info, own = vector.step(actions)[-1], scalar.step(actions[0])[-1]
        np.testing.assert_array_equal(info["truth"][1], own["truth"])
        np.testing.assert_allclose(info["estimate"][1], own["estimate"], rtol=1e-9, atol=1e-9)
