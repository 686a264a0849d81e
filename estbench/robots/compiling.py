"""A robot's description compiled, once with what MuJoCo warns of, and else without."""

import warnings

import mujoco


def compiled(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """The model of a description that has been compiled before, or will be: no warning is repeated.

    Raises:
        ValueError: it does not compile.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return spec.compile()
