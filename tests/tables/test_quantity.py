import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estbench.consistency.intervals import Interval, mean_interval
from estbench.tables.quantity import quantity

INF, NAN = math.inf, math.nan


def around(value, half):
    return Interval(value, value - half, value + half)


@pytest.mark.parametrize(
    ("interval", "text"),
    [
        (around(1.02, 0.0312), "1.020 ± 0.031"),
        (around(0.018316, 0.00021), "0.01832 ± 0.00021"),
        (around(-0.00139, 0.00412), "-0.0014 ± 0.0041"),
        (around(-1.02, 0.0312), "-1.020 ± 0.031"),
        (around(-0.0001, 0.5), "0.00 ± 0.50"),  # no negative zero
        (around(1234.4, 345.0), "1234 ± 345"),
        (around(99_999.0, 1.0), "99999.0 ± 1.0"),
        (Interval(1.01449, 0.97206, 1.05976), "1.014 ± 0.044"),
        (Interval(0.003493, 0.003402, 0.003589), "0.003493 ± 0.000094"),
    ],
)
def test_a_symmetric_interval_has_two_digits_of_its_half_width(interval, text):
    assert quantity(interval) == text


@pytest.mark.parametrize(
    ("interval", "text"),
    [
        (Interval(-1.0, -1.46, -0.7), "-1.00 [-1.46, -0.70]"),
        (Interval(12.34, 3.12, 119.6), "12 [3.1, 120]"),
        (Interval(120.0, 1.2, 90_000.0), "120 [1.2, 90000]"),
        (Interval(1e-7, 1.2e-8, 5.0), "1.0e-07 [1.2e-08, 5.0]"),
    ],
)
def test_a_lopsided_interval_shows_its_ends(interval, text):
    assert quantity(interval) == text


def test_lopsided_is_one_side_half_as_long_again_as_the_other():
    assert quantity(Interval(1.0, 0.7, 1.44)) == "1.00 ± 0.37"
    assert quantity(Interval(1.0, 0.7, 1.46)) == "1.00 [0.70, 1.46]"
    assert quantity(Interval(5e4, 48_770.0, 52_000.0)) == "50000 [48770, 52000]"


@pytest.mark.parametrize(
    ("interval", "text"),
    [
        (around(1.0, 0.0), "1 ± 0"),
        (around(0.0, 0.0), "0 ± 0"),
        (around(100.0, 0.0), "100 ± 0"),
        (around(0.00371234, 0.0), "0.00371234 ± 0"),
        (Interval(0.3, 0.1 + 0.2 - 1e-15, 0.1 + 0.2), "0.3 ± 0"),  # rounding is no width
    ],
)
def test_no_width(interval, text):
    assert quantity(interval) == text


@pytest.mark.parametrize(
    ("interval", "text"),
    [
        (Interval(NAN, NAN, NAN), "–"),
        (Interval(NAN, 0.0, 1.0), "–"),
        (Interval(INF, 0.0, INF), "∞"),
        (Interval(-INF, -INF, 0.0), "-∞"),
        (Interval(2.0, 1.5, INF), "2.00 [1.50, ∞]"),
        (Interval(2.0, -INF, 2.25), "2.00 [-∞, 2.25]"),
        (Interval(2.0, -INF, 2.0), "2.0 [-∞, 2.0]"),
        (Interval(2.0, NAN, NAN), "2"),
        (mean_interval(np.array([0.0123456])), "0.0123"),  # one run
        (mean_interval(np.array([1234.6])), "1235"),
        (mean_interval(np.array([123_456.0])), "1.23e+05"),
        (mean_interval(np.array([])), "–"),
    ],
)
def test_what_is_missing_or_infinite(interval, text):
    assert quantity(interval) == text


@pytest.mark.parametrize(
    ("interval", "text"),
    [
        (Interval(1.5e80, 1e80, 2e80), "1.50e+80 ± 5.0e+79"),
        (Interval(3.0, -1e9, 1e9 + 6), "3.00e+00 ± 1.0e+09"),
        (around(-123_456.0, 12.0), "-1.23456e+05 ± 1.2e+01"),
        (Interval(2.34e7, 99_400.0, 3e80), "2.3e+07 [99400, 3.0e+80]"),
        (Interval(4.4e16, 3.3, 1.2e20), "4.4e+16 [3.3, 1.20e+20]"),
        (around(1e308, 7e307), "1.00e+308 ± 7.0e+307"),
    ],
)
def test_huge_numbers_are_short(interval, text):
    assert quantity(interval) == text


@pytest.mark.parametrize(
    ("interval", "text"),
    [
        (around(3.21e-8, 1.1e-9), "3.21e-08 ± 1.1e-09"),
        (around(0.0, 1e-9), "0 ± 1.0e-09"),
        (around(0.0123456789, 1.2e-8), "1.2345679e-02 ± 1.2e-08"),
        (around(0.000012, 0.0000031), "1.20e-05 ± 3.1e-06"),
        (around(0.000123, 0.000031), "0.000123 ± 0.000031"),
        (around(3e-307, 1.1e-307), "3.00e-307 ± 1.1e-307"),
    ],
)
def test_tiny_numbers_keep_their_digits(interval, text):
    assert quantity(interval) == text


numbers = st.floats(-1e12, 1e12, allow_subnormal=False)
sides = st.floats(-9, 12).map(lambda exponent: 10.0**exponent)


@given(value=numbers, below=sides, ratio=st.floats(1e-3, 1e3) | st.floats(0.9, 1.1))
def test_what_is_read_is_the_interval_to_two_digits_of_its_half_width(value, below, ratio):
    interval = Interval(value, value - below, value + below * ratio)
    half = 0.5 * (interval.high - interval.low)
    if half <= 1e-11 * abs(value):  # arithmetic
        return
    shown = quantity(interval)
    read, *rest = (float(x) for x in re.split(r" ± | \[|, ", shown.rstrip("]")))
    # The unit of the last digit is at most h/10, and rounding is half of it. In ± value and h are
    # rounded, and of sides s and 1.5 s either is a fifth of h away from it.
    unit = 0.1 * half * (1 + 1e-9)
    assert abs(read - value) <= 0.5 * unit
    ends = (read - rest[0], read + rest[0]) if "±" in shown else tuple(rest)
    atol = unit + 0.2 * half if "±" in shown else 0.5 * unit
    np.testing.assert_allclose(ends, (interval.low, interval.high), rtol=1e-12, atol=atol)
