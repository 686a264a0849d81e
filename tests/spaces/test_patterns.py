import numpy as np
import pytest

from estbench.errors import DimensionError, ScenarioError
from estbench.spaces.patterns import expand

NAMES = ("cart", "pole", "cart.vel", "pole.vel")


def test_a_number_is_for_all():
    np.testing.assert_array_equal(expand(2, NAMES, "std"), [2.0] * 4)


def test_a_list_is_one_each():
    np.testing.assert_array_equal(expand([1, 2, 3, 4], NAMES, "std"), [1, 2, 3, 4])
    np.testing.assert_array_equal(expand([5.0], NAMES, "std"), [5] * 4)


def test_later_patterns_win_and_the_rest_gets_the_default():
    np.testing.assert_array_equal(expand({"*": 1, "*.vel": 2}, NAMES, "std"), [1, 1, 2, 2])
    np.testing.assert_array_equal(expand({"*.vel": 2, "*": 1}, NAMES, "std"), [1, 1, 1, 1])
    np.testing.assert_array_equal(expand({"pole": 3}, NAMES, "std", default=7), [7, 3, 7, 7])
    np.testing.assert_array_equal(expand({}, NAMES, "std"), [0] * 4)


def test_patterns_are_case_sensitive_and_match_whole_names():
    np.testing.assert_array_equal(expand({"p*": 1}, NAMES, "std"), [0, 1, 0, 1])
    with pytest.raises(ScenarioError):
        expand({"Pole": 1}, NAMES, "std")


def test_a_pattern_that_matches_nothing():
    with pytest.raises(ScenarioError, match=r"initial\.std: 'poel' matches none.*mean 'pole'"):
        expand({"poel": 1.0}, NAMES, "initial.std")


@pytest.mark.parametrize("value", [[1.0, 2.0], [1.0] * 5, [[1.0] * 4]])
def test_a_list_of_another_length(value):
    with pytest.raises(DimensionError, match=r"std has \d values; expected 1 or 4 \(cart, pole"):
        expand(value, NAMES, "std")


def test_no_names():
    assert expand(1.0, (), "density").shape == (0,)
    assert expand({"*": 1.0}, (), "density").shape == (0,)


def test_the_result_is_the_callers_own():
    value = np.ones(4)
    out = expand(value, NAMES, "std")
    out[0] = 5.0
    assert value[0] == 1.0
