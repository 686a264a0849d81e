"""The exception tree: every error that estbench raises on purpose is an `EstbenchError`.

A message names the argument, the value received and the remedy; the command line prints it as one
line and exits with code 2.
"""

import difflib
from collections.abc import Iterable


class EstbenchError(Exception):
    """Base of all errors raised by estbench."""


class ScenarioError(EstbenchError):
    """A scenario, its TOML file or its MJCF is wrong."""


class DimensionError(EstbenchError):
    """An array has another shape than its place needs."""


class CovarianceError(EstbenchError):
    """A matrix that must be symmetric positive (semi)definite is not."""


class ModelError(EstbenchError):
    """A function of a user's model is none, or raised."""


class EstimatorError(EstbenchError):
    """An estimator is unknown, lacks a method, or has a setting out of range."""


class ControllerError(EstbenchError):
    """A controller cannot be built, raised, or returned something unusable."""


class StoreError(EstbenchError):
    """Results cannot be written or read."""


class ExecutorError(EstbenchError):
    """Workers cannot be had, or died."""


class AnalysisError(EstbenchError):
    """A comparison or a report of results was asked for with a setting that makes no sense."""


class Interrupted(EstbenchError):  # noqa: N818 - it is no error but the user's wish
    """Ctrl-C came before there was anything to show; the command line exits with 130."""


class MissingExtraError(EstbenchError):
    """An optional dependency is not installed."""

    def __init__(self, package: str, extra: str):
        super().__init__(
            f"{package} is not installed; it comes with the extra '{extra}': "
            f"pip install 'estbench[{extra}]'"
        )


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """A hint ` (did you mean 'x'?)` for a misspelt name, or the list of what there is."""
    known = sorted(known)
    close = difflib.get_close_matches(name, known, n=2, cutoff=0.6)
    if close:
        return " (did you mean " + " or ".join(f"'{c}'" for c in close) + "?)"
    return f" (known: {', '.join(known)})" if known else ""
