"""The one exception of the Gymnasium side; it is an `EstbenchError` like all others."""

from estbench.errors import EstbenchError


class EnvError(EstbenchError):
    """An environment cannot be wrapped, or was used outside its contract."""
