"""Calling the functions of a user's model: what they raise and return, said in words."""

from collections.abc import Callable
from typing import Any

import numpy as np

from estbench.errors import DimensionError, ModelError, user_error_location
from estbench.shapes import Array

Matrix = Array | Callable[..., Array]
"""A matrix, or a function of time that returns one."""


def call(name: str, function: Callable[..., Any], *args: Any) -> Any:
    """What a user's function returns.

    Raises:
        ModelError: it raised, or takes other arguments; the user's error is the cause.
    """
    try:
        return function(*args)
    except Exception as error:
        shapes = " and ".join(str(a.shape) for a in args if isinstance(a, np.ndarray))
        given = f"{len(args)} arguments" + (f", arrays of shapes {shapes}" if shapes else "")
        raise ModelError(
            f"{name} raised {user_error_location(error)}; it was called with {given}"
        ) from error


def numbers(what: str, given: Any, expected: str) -> Array:
    """What a user gave as float64 numbers; `what` begins the message, e.g. `f returned`.

    Raises:
        DimensionError: it is no array of real numbers, or one of float32, in which a Jacobian by
            differences would be noise.
    """
    try:
        out = np.asarray(given)
    except ValueError:  # parts of several shapes
        out = np.empty(0, object)
    if out.dtype.kind not in "biuf" or (out.dtype.kind == "f" and out.dtype.itemsize < 8):
        raise DimensionError(
            f"{what} {type(given).__name__} of {out.dtype}; expected float64 numbers, {expected}"
        )
    return out.astype(np.float64, copy=False)


def matrix_at(name: str, matrix: Matrix, *time: float) -> Array:
    """A matrix, or what its function of time returns.

    Raises:
        ModelError, DimensionError: as for `call` and `numbers`.
    """
    if callable(matrix):
        return numbers(f"{name} returned", call(name, matrix, *time), "a matrix")
    return numbers(f"{name} is", matrix, "a matrix")
