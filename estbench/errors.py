"""The exception tree: every error that estbench raises on purpose is an `EstbenchError`.

A message names the argument, the value received and the remedy; the command line prints it as one
line and exits with code 2.
"""

import difflib
import sys
import traceback
from collections.abc import Iterable
from pathlib import Path

# Packages whose lines tell a user nothing: the mistake is where they were called from.
_OTHERS = sys.stdlib_module_names | {"estbench", "numpy", "scipy", "mujoco"}


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


class SelectionError(EstimatorError):
    """A belief cannot be taken apart by runs: some of it is shared between them."""


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


def user_error_location(error: BaseException) -> str:
    """What a user's code raised, and where: `KeyError: 'gain' (mine.py:12, in update)`.

    The place is the innermost line of the user's files: those of the folder of the first file that
    is neither estbench's nor of what it stands on. Where there is none it is left out, as it is of
    a syntax error, which says itself where it is.
    """
    text = f"{type(error).__name__}: {error}"
    if isinstance(error, SyntaxError):
        return text
    frames = [
        (Path(frame.f_code.co_filename), line, frame.f_code.co_name)
        for frame, line in traceback.walk_tb(error.__traceback__)
        if frame.f_globals.get("__name__", "").partition(".")[0] not in _OTHERS
    ]
    own = [frame for frame in frames if frame[0].parent == frames[0][0].parent]
    if not own:
        return text
    file, line, name = own[-1]
    return f"{text} ({file.name}:{line}, in {name})"
