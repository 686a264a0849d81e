"""A robot's description compiled; what MuJoCo warns of it is said once."""

import multiprocessing
import warnings
from functools import cache

import mujoco


def compiled(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """The model of a description; an experiment compiles several copies of it.

    Raises:
        ValueError: it does not compile.
    """
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        model = spec.compile()
    for each in found if multiprocessing.parent_process() is None else ():
        _say(str(each.message))
    return model


@cache
def _say(text: str) -> None:
    """Say it, if this process has not yet."""
    warnings.warn(text, UserWarning, stacklevel=3)
