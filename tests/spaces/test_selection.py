from dataclasses import dataclass

import numpy as np
import pytest

from estbench.errors import SelectionError
from estbench.spaces.selection import chosen, select


def test_rows_by_number_as_a_mask():
    assert chosen(np.array([2, 0]), 4).tolist() == [True, False, True, False]


@dataclass(frozen=True)
class Odd:
    a: np.ndarray
    step: int


def test_select_refuses_what_rows_share():
    mask = np.array([True, False])
    new, old = Odd(np.ones((2, 3)), 0), Odd(np.zeros((2, 3)), 0)
    np.testing.assert_array_equal(select(mask, new, old).a, [[1, 1, 1], [0, 0, 0]])
    with pytest.raises(
        SelectionError, match=r"belief.step \(int\) is not kept row by row.*dataclass"
    ):
        select(mask, Odd(new.a, 1), old)
    assert select(mask, (None, new.a), (old.a, old.a))[0] is None
    assert set(select(mask, {"a": new.a}, {"a": old.a, "b": old.a})) == {"a"}
