"""The one exception of the Gymnasium side; it is an `EstbenchError` like all others."""

from estbench.errors import EstbenchError, shown


class EnvError(EstbenchError):
    """An environment cannot be wrapped, or was used outside its contract."""


def check_switch(name: str, value: object) -> None:
    """Refuse a setting that is neither true nor false."""
    if not isinstance(value, bool):
        raise EnvError(f"{name} is {shown(value)}; use True or False")


def check_threads(nthread: object) -> None:
    """Refuse a number of threads that is no whole number of at least 1, nor None."""
    whole = isinstance(nthread, int) and not isinstance(nthread, bool)
    if nthread is not None and not (whole and nthread >= 1):  # type: ignore[operator]
        raise EnvError(
            f"nthread is {shown(nthread)}; use a whole number of at least 1, or None to leave it "
            "to estbench"
        )


def not_running(closed: bool) -> EnvError:
    """The error of a `step` that has no episode, or of any call after `close()`."""
    if closed:
        return EnvError("the environment is closed; make a new one")
    return EnvError("step() after the end of an episode, or before the first; call reset()")
