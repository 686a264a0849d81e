"""The one exception of the Gymnasium side; it is an `EstbenchError` like all others."""

from estbench.errors import EstbenchError, shown


class EnvError(EstbenchError):
    """An environment cannot be wrapped, or was used outside its contract."""


def check_switch(name: str, value: object) -> None:
    """Refuse a setting that is neither true nor false."""
    if not isinstance(value, bool):
        raise EnvError(f"{name} is {shown(value)}; use True or False")


def not_running(closed: bool) -> EnvError:
    """The error of a `step` that has no episode, or of any call after `close()`."""
    if closed:
        return EnvError("the environment is closed; make a new one")
    return EnvError("step() after the end of an episode, or before the first; call reset()")
