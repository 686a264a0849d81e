"""Checks of settings; an error names the estimator, the setting, the value and the remedy."""

from collections.abc import Sequence
from math import isfinite
from typing import Any

from estbench.errors import EstimatorError


def one_of(estimator: Any, setting: str, allowed: Sequence[str]) -> None:
    """Raise unless the setting is one of the allowed words."""
    value = getattr(estimator, setting)
    if value not in allowed:
        raise EstimatorError(
            f"{type(estimator).__name__}: {setting} is {value!r}; use one of {', '.join(allowed)}"
        )


def in_range(
    estimator: Any,
    setting: str,
    low: float = float("-inf"),
    high: float = float("inf"),
    *,
    low_open: bool = False,
) -> None:
    """Raise unless the setting is a number in [low, high], or in (low, high] if `low_open`."""
    value = getattr(estimator, setting)
    number = isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)
    inside = number and (low < value <= high if low_open else low <= value <= high)
    if not inside:
        bracket = "(" if low_open else "["
        raise EstimatorError(
            f"{type(estimator).__name__}: {setting} is {value!r}; use a number in "
            f"{bracket}{low:g}, {high:g}]"
        )


def switch(estimator: Any, setting: str) -> None:
    """Raise unless the setting is true or false."""
    value = getattr(estimator, setting)
    if not isinstance(value, bool):
        raise EstimatorError(
            f"{type(estimator).__name__}: {setting} is {value!r}; use true or false"
        )


def whole(estimator: Any, setting: str, low: int) -> None:
    """Raise unless the setting is an integer of at least `low`."""
    value = getattr(estimator, setting)
    if not isinstance(value, int) or isinstance(value, bool) or value < low:
        raise EstimatorError(
            f"{type(estimator).__name__}: {setting} is {value!r}; use an integer of at least {low}"
        )
