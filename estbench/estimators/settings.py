"""Checks of settings; an error names the estimator, the setting, the value and the remedy."""

from collections.abc import Mapping, Sequence
from math import isfinite
from typing import Any

import numpy as np

from estbench.errors import EstimatorError, shown


def has_model(estimator: Any) -> None:
    """Raise unless the estimator's model has a state space."""
    if not hasattr(estimator.model, "space"):
        raise EstimatorError(
            f"{type(estimator).__name__}: model is of type {type(estimator.model).__name__}; give "
            "a model, e.g. estbench.FunctionModel"
        )


def one_of(estimator: Any, setting: str, allowed: Sequence[str]) -> None:
    """Raise unless the setting is one of the allowed values."""
    if getattr(estimator, setting) not in allowed:
        raise _refusal(estimator, setting, f"one of {', '.join(allowed)}")


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
    inside = _finite(value) and (low < value <= high if low_open else low <= value <= high)
    if not inside:
        bracket = "(" if low_open else "["
        raise _refusal(estimator, setting, f"a number in {bracket}{low:g}, {high:g}]")


def below(estimator: Any, setting: str, bound: float) -> None:
    """Raise unless the setting is a number below the bound."""
    value = getattr(estimator, setting)
    if not (_finite(value) and value < bound):
        raise _refusal(estimator, setting, f"a number below {bound:g}")


def whole(estimator: Any, setting: str, low: int, high: float = float("inf")) -> None:
    """Raise unless the setting is an integer of at least `low` and at most `high`."""
    value = getattr(estimator, setting)
    integer = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not (integer and low <= value <= high):
        most = "" if high == float("inf") else f" and at most {high}"
        raise _refusal(estimator, setting, f"an integer of at least {low}{most}")


def base(estimator: Any, allowed: Sequence[str]) -> None:
    """Raise unless the setting `base` is one of the filters allowed, or a user's own."""
    if estimator.base not in allowed and ":" not in str(estimator.base):
        raise _refusal(
            estimator, "base", f"one of {', '.join(allowed)}, or your own as package.module:Name"
        )


def switch(estimator: Any, setting: str) -> None:
    """Raise unless the setting is true or false."""
    if not isinstance(getattr(estimator, setting), bool):
        raise _refusal(estimator, setting, "true or false")


def names(estimator: Any, setting: str) -> None:
    """Raise unless the setting is a list of strings."""
    value = getattr(estimator, setting)
    listed = isinstance(value, Sequence) and not isinstance(value, str)
    if not (listed and all(isinstance(item, str) for item in value)):
        raise _refusal(estimator, setting, "a list of names or patterns")


def table(estimator: Any, setting: str) -> None:
    """Raise unless the setting is a table."""
    if not isinstance(getattr(estimator, setting), Mapping):
        raise _refusal(estimator, setting, "a table of settings")


def scaled_rule(estimator: Any) -> None:
    """Raise unless `alpha`, `beta` and `kappa` suit a scaled unscented transform."""
    in_range(estimator, "alpha", 0.0, 1.0, low_open=True)
    in_range(estimator, "beta", 0.0)
    in_range(estimator, "kappa")
    n = estimator.model.space.n
    if not n + estimator.kappa > 0:
        raise EstimatorError(
            f"{type(estimator).__name__}: kappa is {estimator.kappa!r}; n + kappa must be "
            f"positive, so use a value above {-n}"
        )


def _finite(value: Any) -> bool:
    """Whether a setting is a finite number, and not true or false."""
    real = isinstance(value, int | float | np.integer | np.floating)
    return real and not isinstance(value, bool) and isfinite(value)


def _refusal(estimator: Any, setting: str, remedy: str) -> EstimatorError:
    value = getattr(estimator, setting)
    return EstimatorError(f"{type(estimator).__name__}: {setting} is {shown(value)}; use {remedy}")
