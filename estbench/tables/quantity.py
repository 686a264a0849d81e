"""A number and its interval as text, the same for every command, table and page."""

import math

from estbench.consistency.intervals import Interval

LARGE = 1e5
"""Numbers of at least this size are written with a power of ten."""
DECIMALS = 6
"""Numbers that need more decimals are written with a power of ten."""
LOPSIDED = 1.5
"""An interval is written with its ends where one side is more than this times the other."""
ROUNDING = 1e-12
"""An interval narrower than this part of its value is a rounding error."""


def quantity(i: Interval) -> str:
    """`1.020 ± 0.031`, or with its ends, `12 [3.1, 120]`, where the interval is lopsided.

    The half-width (high - low)/2 has two digits, and the value ends at the same decimal place.
    Where one side is more than `LOPSIDED` times the other, ± would mislead (12 ± 58 contains 1, and
    the interval does not). The two ends are then written to the same place, with at least two
    digits each.

    A value without an interval (one run) has three digits, or all digits before the point. One
    whose interval has no width is followed by `± 0`. NaN is `–`, infinity `∞`.

    Args:
        i: the value and its interval.
    """
    if not math.isfinite(i.value):
        return "–" if math.isnan(i.value) else "∞" if i.value > 0 else "-∞"
    below, above = i.value - i.low, i.high - i.value
    sides = [side for side in (below, above) if math.isfinite(side)]
    if not sides:
        return _alone(i.value, 3)
    half = sum(side / len(sides) for side in sides)
    place = _place(half)
    if len(sides) == 2:
        if half <= ROUNDING * abs(i.value):
            return f"{_alone(i.value, 6)} ± 0"
        large = max(abs(i.value), half) >= LARGE or place > DECIMALS
        if max(sides) <= LOPSIDED * min(sides):
            if large:
                return f"{_power(i.value, place, 2)} ± {_power(half, place)}"
            return f"{_fixed(i.value, place)} ± {_fixed(half, place)}"
    value, low, high = (_end(x, place) for x in (i.value, i.low, i.high))
    return f"{value} [{low}, {high}]"


def _place(x: float) -> int:
    """Decimals that show two digits of x; negative where both are before the point."""
    return 1 - math.floor(math.log10(abs(x))) if x else 0


def _fixed(x: float, decimals: int) -> str:
    return f"{x:z.{max(decimals, 0)}f}"  # z: no negative zero


def _power(x: float, decimals: int, least: int = 1) -> str:
    """With a power of ten, to the place of `decimals`, at least `least` digits after the point."""
    return f"{x:.{max(decimals + 1 - _place(x), least)}e}" if x else "0"


def _end(x: float, decimals: int) -> str:
    """One end of an interval, to the place of `decimals`, with at least two digits."""
    if not math.isfinite(x):
        return "∞" if x > 0 else "-∞"
    decimals = max(decimals, _place(x))
    large = abs(x) >= LARGE or decimals > DECIMALS
    return _power(x, decimals) if large else _fixed(x, decimals)


def _alone(x: float, digits: int) -> str:
    """To `digits` digits, or all before the point if they are more."""
    if abs(x) >= LARGE:
        return f"{x:.{digits - 1}e}"
    return f"{x:z.{max(digits, len(f'{abs(x):.0f}'))}g}"


def bounds(i: Interval, decimals: int = 3) -> str:
    """`1.021 [1.013, 1.030]`: always with the ends of the interval."""
    if math.isnan(i.value):
        return "–"
    low, high = (f"{x:.{decimals}f}" if abs(x) < 1e4 else f"{x:.2g}" for x in (i.low, i.high))
    return f"{number(i.value, decimals)} [{low}, {high}]".replace("inf", "∞")


def percent(i: Interval, decimals: int = 1) -> str:
    """A share in percent with its interval: `2.0% [0.8, 5.0]`."""
    if math.isnan(i.value):
        return "–"
    value, low, high = (f"{100 * x:.{decimals}f}" for x in (i.value, i.low, i.high))
    return f"{value}% [{low}, {high}]"


def number(x: float, decimals: int | None = None, tiny: bool = False) -> str:
    """A number to `decimals`, or to three digits; `–` for NaN, `∞` for infinity.

    Args:
        x: the number.
        decimals: after the point; None for three digits.
        tiny: whether one that would be shown as 0.000, and is not 0, has a power of ten.
    """
    if not math.isfinite(x):
        return "–" if math.isnan(x) else "∞" if x > 0 else "-∞"
    if decimals is None and 999.5 <= abs(x) < 1e6:
        return f"{x:.0f}"
    if tiny and decimals is not None and 0 < abs(x) < 10.0**-decimals:
        return f"{x:.2e}"
    return f"{x:.3g}" if decimals is None or abs(x) >= 1e4 else f"{x:.{decimals}f}"


def probability(p: float) -> str:
    """A p-value: `0.012`, or `<0.001`; `–` for NaN."""
    return "–" if math.isnan(p) else "<0.001" if p < 0.001 else f"{p:.3f}"
