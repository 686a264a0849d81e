"""Rows that count their own draws have the numbers of their runs' streams, in any company."""

import numpy as np
import pytest

from estbench.randomness import streams
from estbench.randomness.row_draws import RowDraws

ROWS, WIDTH = 5, 3
KINDS = {"normal": streams.normals, "uniform": streams.uniforms}


class OneByOne:
    """The same numbers, taken row by row from a long record of each stream."""

    def __init__(self, kind):
        self.numbers, self.records, self.count = KINDS[kind], {}, np.zeros(ROWS, int)

    def start(self, rows, seeds, runs):
        for row, seed, run in zip(rows, seeds, runs):
            self.records[row] = self.numbers(seed, [run], "a", 400, WIDTH)[:, 0]
            self.count[row] = 0

    def draw(self, mask):
        out = {row: self.records[row][self.count[row]] for row in np.flatnonzero(mask)}
        self.count[mask] += 1
        return out


def assert_drawn(draws, reference, mask):
    found = draws.draw(None if mask is None else mask.copy())
    here = np.ones(ROWS, bool) if mask is None else mask
    for row, expected in reference.draw(here).items():
        np.testing.assert_array_equal(found[row], expected)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("block", [1, 2, 7, 32])
def test_all_rows_together_have_the_numbers_of_the_streams(kind, block):
    draws = RowDraws(ROWS, {"a": WIDTH}, kind, block)
    draws.start(np.arange(ROWS), 4, range(10, 10 + ROWS))
    found = np.array([draws.draw().copy() for _ in range(70)])
    expected = KINDS[kind](4, range(10, 10 + ROWS), "a", 70, WIDTH)
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("block", [1, 2, 7, 32])
@pytest.mark.parametrize("seed", range(5))
def test_masks_and_restarts_of_single_rows_move_no_other_row(kind, block, seed):
    rng = np.random.default_rng(seed)
    draws, reference = RowDraws(ROWS, {"a": WIDTH}, kind, block), OneByOne(kind)
    everyone = list(range(ROWS))
    draws.start(np.arange(ROWS), 1, everyone)
    reference.start(everyone, [1] * ROWS, everyone)
    restarts = 0
    for number in range(200):
        if rng.random() < 0.1:
            size = int(rng.integers(1, ROWS + 1))
            rows = rng.permutation(ROWS)[:size]
            seeds, runs = rng.integers(0, 9, size).tolist(), rng.integers(0, 99, size).tolist()
            draws.start(rows, seeds, runs)
            reference.start(rows.tolist(), seeds, runs)
            restarts += 1
        # At first long without a mask: the rows have the same count then.
        masked = number > 60 and rng.random() < 0.7
        assert_drawn(draws, reference, rng.random(ROWS) < 0.6 if masked else None)
    assert restarts > 5


@pytest.mark.parametrize("block", [3, 32])
def test_the_first_mask_comes_where_a_block_ends(block):
    draws, reference = RowDraws(ROWS, {"a": WIDTH}, block=block), OneByOne("normal")
    everyone, mask = list(range(ROWS)), np.array([True, False, True, False, False])
    draws.start(np.arange(ROWS), 1, everyone)
    reference.start(everyone, [1] * ROWS, everyone)
    for _ in range(block):
        assert_drawn(draws, reference, None)
    for each in (mask, mask, ~mask, None, ~mask, None):
        assert_drawn(draws, reference, each)


def test_a_row_that_began_anew_where_a_block_ends():
    draws, reference = RowDraws(ROWS, {"a": WIDTH}, block=4), OneByOne("normal")
    everyone = list(range(ROWS))
    draws.start(np.arange(ROWS), 1, everyone)
    reference.start(everyone, [1] * ROWS, everyone)
    for _ in range(4):
        assert_drawn(draws, reference, None)
    draws.start(np.array([2]), [8], [77])
    reference.start([2], [8], [77])
    for _ in range(9):
        assert_drawn(draws, reference, None)


def test_a_block_is_shaped_draw_by_draw():
    def shape(block):
        return block * np.array([1.0, 2.0, 3.0])

    plain, shaped = RowDraws(2, {"a": 3}, block=4), RowDraws(2, {"a": 3}, block=4, shape=shape)
    for draws in (plain, shaped):
        draws.start(np.arange(2), 0, [0, 1])
    for _ in range(9):
        np.testing.assert_array_equal(shaped.draw(), shape(plain.draw()))


def test_nothing_to_draw():
    draws = RowDraws(2, {"a": 0})
    draws.start(np.arange(2), 0, [0, 1])
    assert draws.draw().shape == (2, 0)
    assert draws.draw(np.array([True, False])).shape == (2, 0)
