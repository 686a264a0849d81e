# pyright: reportOptionalMemberAccess=false, reportArgumentType=false
# pyright: reportOptionalSubscript=false, reportGeneralTypeIssues=false
import numpy as np
import pytest

from estbench.envs.keys import RowKeys, RowNoise, draw_key

KEYS = np.array([7, 11, 13], np.uint64)
ALL = np.ones(3, bool)


def test_a_row_is_the_same_alone_and_in_company():
    many, one = RowNoise(3, {"a": 2, "b": 1}), RowNoise(1, {"a": 2, "b": 1})
    many.start(ALL, KEYS)
    one.start(ALL[:1], KEYS[1:2])
    together = np.array([many.draw() for _ in range(100)])
    alone = np.array([one.draw() for _ in range(100)])
    np.testing.assert_array_equal(together[:, 1], alone[:, 0])


def test_a_part_does_not_depend_on_its_neighbours():
    wide, narrow = RowNoise(3, {"a": 2, "b": 1}), RowNoise(3, {"b": 1})
    wide.start(ALL, KEYS)
    narrow.start(ALL, KEYS)
    for _ in range(70):
        np.testing.assert_array_equal(wide.draw()[:, 2:], narrow.draw())


def test_rows_that_wait_do_not_move_on_and_new_episodes_start_over():
    noise = RowNoise(3, {"a": 1})
    noise.start(ALL, KEYS)
    straight = np.array([noise.draw() for _ in range(64)])
    noise.start(ALL, KEYS)
    mask = np.array([True, False, True])
    for k in range(40):
        out = noise.draw(mask)
        np.testing.assert_array_equal(out[mask], straight[k, mask])
        np.testing.assert_array_equal(out[1], straight[0, 1])
    noise.start(np.array([True, False, False]), KEYS[:1])
    np.testing.assert_array_equal(noise.draw()[0], straight[0, 0])


def test_they_are_standard_normals():
    noise = RowNoise(500, {"a": 3})
    noise.start(np.ones(500, bool), np.arange(500, dtype=np.uint64))
    z = np.array([noise.draw() for _ in range(100)])
    assert abs(z.mean()) < 4 / np.sqrt(z.size)
    assert abs(z.var() - 1) < 4 * np.sqrt(2 / z.size)
    step = np.corrcoef(z[1:].ravel(), z[:-1].ravel())[0, 1]
    assert abs(step) < 4 / np.sqrt(z.size)


def test_seeds():
    a, b, other = RowKeys(2), RowKeys(2), RowKeys(2, "sensors")
    for keys in (a, b, other):
        for row in range(2):
            keys.seed(row, 5 + row)
    np.testing.assert_array_equal(a.draw([0, 1]), b.draw([0, 1]))
    assert not np.isin(a.draw([0, 1]), other.draw([0, 1])).any()
    for row in range(2):
        a.seed(row, None)  # goes on
    assert a.draw([0]) == b.draw([0, 0])[1]
    unseeded = RowKeys(2).draw([0, 1])
    assert unseeded[0] != unseeded[1]


@pytest.mark.parametrize("seed", [0, 3])
def test_row_i_is_the_scalar_environment_of_seed_plus_i(seed):
    from gymnasium.utils import seeding

    keys = RowKeys(1)
    keys.seed(0, seed)
    assert keys.draw([0])[0] == draw_key(seeding.np_random(seed)[0])
