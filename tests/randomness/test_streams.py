import zlib

import numpy as np
import pytest
from scipy import stats

from estbench.experiment import recording, setup
from estbench.montecarlo import run as experiment
from estbench.randomness import seeding, streams
from estbench.sensors.delivery import divided

PURPOSES = ("initial", "process", "control", "sensor:gyro", "sensor:gyr0")


def test_a_run_has_the_same_numbers_in_any_batch():
    whole = streams.normals(5, range(10), "process", 7, 3)
    some = streams.normals(5, [7, 2, 9], "process", 7, 3)
    np.testing.assert_array_equal(some, whole[:, [7, 2, 9]])


def test_the_first_steps_do_not_depend_on_how_many_follow():
    long, short = (streams.normals(5, range(4), "process", steps, 3) for steps in (50, 20))
    np.testing.assert_array_equal(short, long[:20])


def test_every_seed_run_and_purpose_has_its_own_numbers():
    drawn = {
        streams.normals(seed, [run], purpose, 1, 1).item()
        for seed in (0, 1)
        for run in range(20)
        for purpose in PURPOSES
    }
    assert len(drawn) == 2 * 20 * len(PURPOSES)


def test_numbers_are_standard_normal_and_uncorrelated_between_streams():
    draws = np.stack([streams.normals(1, range(4), p, 5000, 1)[..., 0] for p in PURPOSES])
    assert stats.kstest(draws.ravel(), "norm").pvalue > 1e-7  # false alarm 1e-7
    rows = draws.transpose(0, 2, 1).reshape(-1, 5000)
    correlation = np.corrcoef(rows)[np.triu_indices(len(rows), 1)]
    # 190 pairs, each N(0, 1/5000): beyond 6 sigma with probability 4e-7.
    assert np.abs(correlation).max() < 6 / np.sqrt(5000)


@pytest.mark.parametrize("shape", [(0, 3), (4, 0)])
def test_nothing_to_draw(shape):
    for draw in (streams.normals, streams.uniforms):
        assert draw(0, range(2), "process", *shape).shape == (shape[0], 2, shape[1])


def test_uniforms_are_those_of_the_run_in_any_batch():
    whole = streams.uniforms(5, range(4), "sensor:gyro:dropout", 5000, 1)
    some = streams.uniforms(5, [3], "sensor:gyro:dropout", 20, 1)
    np.testing.assert_array_equal(some[:, 0], whole[:20, 3])
    assert stats.kstest(whole.ravel(), "uniform").pvalue > 1e-7


def test_keys_depend_on_seed_run_and_purpose_only():
    keys = streams.run_keys(3, range(6), "estimator:enkf")
    assert keys.dtype == np.uint64
    np.testing.assert_array_equal(streams.run_keys(3, [4, 1], "estimator:enkf"), keys[[4, 1]])
    others = [streams.run_keys(3, range(6), "estimator:pf"), streams.run_keys(4, range(6), "x")]
    assert len(set(np.concatenate([keys, *others]).tolist())) == 18


@pytest.mark.parametrize("seed", [0, 1, 2**32 - 1, 2**32, 2**128 - 1, 2**128, 2**300 + 5])
def test_streams_are_those_of_numpys_seed_sequence(seed):
    runs, word = [0, 1, 7, 2**32 - 1], zlib.crc32(b"process")
    theirs = [np.random.SeedSequence(seed, spawn_key=(run, word)) for run in runs]
    np.testing.assert_array_equal(
        seeding.words(seed, runs, word, 5), [s.generate_state(5, np.uint64) for s in theirs]
    )
    drawn = [np.random.Generator(np.random.SFC64(s)).standard_normal((3, 2)) for s in theirs]
    np.testing.assert_array_equal(
        streams.normals(seed, runs, "process", 3, 2), np.swapaxes(drawn, 0, 1)
    )


def recorded(overrides, runs=range(3)):
    """The truth of some runs, and each channel's readings `(instant, run, ny)`."""
    overrides = [*overrides, "control={kind='sine', amplitude=0.4}"]  # feedback would round
    prepared = setup.build(experiment.resolve("cartpole", duration=0.2, overrides=overrides))
    trajectory = recording.trajectory(prepared, runs)
    named = [{d.channels[0]: d.y for d in divided(arrived)} for arrived in trajectory.deliveries]
    return {name: np.array([each[name] for each in named]) for name in named[0]}, trajectory


def test_adding_a_sensor_leaves_the_truth_and_the_other_sensors_noise():
    two, before = recorded([])
    three, after = recorded(['sensors=["gyro", "pole_encoder", "cart_encoder"]'])
    assert set(three) == {*two, "gyro"}
    for name, y in two.items():
        np.testing.assert_array_equal(three[name], y)
    np.testing.assert_array_equal(after.x, before.x)


def test_a_run_is_the_same_whichever_runs_are_beside_it():
    together, whole = recorded([], range(5))
    alone, one = recorded([], [3])
    for name, y in alone.items():
        np.testing.assert_array_equal(y[:, 0], together[name][:, 3])
    np.testing.assert_array_equal(one.x[:, 0], whole.x[:, 3])
