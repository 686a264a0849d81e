"""Calls of the functions of a user's model, with errors that name the function and the remedy."""

from collections.abc import Callable
from typing import Any

import numpy as np

from estbench.errors import DimensionError, ModelError, user_error_location
from estbench.shapes import Array

Matrix = Array | Callable[..., Array]
"""A matrix, or a function of time that returns one."""


def call(name: str, function: Callable[..., Any], *args: Any) -> Any:
    """Call a user's function and return its result.

    Raises:
        ModelError: it raised, or takes other arguments; the user's error is the cause.
    """
    try:
        return function(*args)
    except (Exception, SystemExit) as error:
        shapes = " and ".join(str(a.shape) for a in args if isinstance(a, np.ndarray))
        given = f"{len(args)} arguments" + (f", arrays of shapes {shapes}" if shapes else "")
        raise ModelError(
            f"{name} raised {user_error_location(error)}; it was called with {given}"
        ) from error


def numbers(what: str, given: Any, expected: str) -> Array:
    """A user's value as an array of float64; `what` begins the message, e.g. `f returned`.

    Raises:
        DimensionError: the value is not an array of real numbers, or is masked, or it is float32,
            whose rounding errors would dominate a Jacobian by differences.
    """
    if isinstance(given, np.ma.MaskedArray):
        raise DimensionError(
            f"{what} a masked array, whose mask would be lost; expected float64 numbers, {expected}"
        )
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
    """A matrix that is given as such or as a function of time.

    Raises:
        ModelError, DimensionError: as for `call` and `numbers`.
    """
    if callable(matrix):
        return numbers(f"{name} returned", call(name, matrix, *time), "a matrix")
    return numbers(f"{name} is", matrix, "a matrix")
