"""The exception tree: every error that estbench raises on purpose is an `EstbenchError`.

A message names the argument, the value received and the remedy; the command line prints it as one
line and exits with code 2.
"""

import difflib
import os
import sys
import traceback
from collections.abc import Iterable
from pathlib import Path

# Packages whose lines do not locate a mistake: it is in the code that calls them.
_OTHERS = sys.stdlib_module_names | {"estbench", "numpy", "scipy", "mujoco"}


TRUST = "ESTBENCH_TRUST"
"""The environment variable that allows code of others (`scenario.code`); `--trust` sets it."""


class EstbenchError(Exception):
    """Base of all errors raised by estbench."""


class ScenarioError(EstbenchError):
    """A scenario, its TOML file or its MJCF is wrong."""


class DimensionError(EstbenchError):
    """An array has the wrong shape."""


class CovarianceError(EstbenchError):
    """A matrix that must be symmetric positive (semi)definite is not."""


class ModelError(EstbenchError):
    """A function of a user's model is not callable, or raised."""


class EstimatorError(EstbenchError):
    """An estimator is unknown, lacks a method, or has a setting out of range."""


class SelectionError(EstimatorError):
    """A belief cannot be divided by runs: a part of it is shared between them."""


class ControllerError(EstbenchError):
    """A controller cannot be built, raised, or returned something unusable."""


class StudyError(EstbenchError):
    """A sweep or a tuning has an invalid setting."""


class LogError(EstbenchError):
    """A recorded log cannot be read, or does not fit its scenario."""


class StoreError(EstbenchError):
    """Results cannot be written or read."""


class ExecutorError(EstbenchError):
    """Workers cannot be started, or died."""


class AnalysisError(EstbenchError):
    """A comparison or a report of results has an invalid setting."""


class Interrupted(EstbenchError):  # noqa: N818 - the user asked for it
    """Ctrl-C came before any result; the command line exits with code 130."""


class MissingExtraError(EstbenchError):
    """An optional dependency is not installed."""

    def __init__(self, package: str, extra: str):
        super().__init__(
            f"{package} is not installed; it comes with the extra '{extra}': "
            f"pip install 'estbench[{extra}]'"
        )


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """A hint ` (did you mean 'x'?)` for a misspelt name, or the list of the known names."""
    known = sorted(known)
    close = difflib.get_close_matches(name, known, n=2, cutoff=0.6)
    if close:
        return " (did you mean " + " or ".join(f"'{c}'" for c in close) + "?)"
    return f" (known: {', '.join(known)})" if known else ""


def shown(value: object) -> str:
    """A value in one line of a message: that of an array has many."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 80 else f"{text[:77]}..."


def given_path(what: str, value: object, error: type[EstbenchError]) -> Path:
    """The path that a user gives.

    Raises:
        error: it is no text or path, or no file system has such a name; `what` begins the message.
    """
    if not isinstance(value, str | os.PathLike):
        raise error(f"{what} is {shown(value)}; use a path")
    path = Path(value)
    try:
        path.exists()  # most wrong names are no error, but only do not exist
    except OSError as wrong:
        raise error(f"{what} is '{str(path)[:40]}...': {wrong.strerror}") from None
    return path


def user_error_location(error: BaseException) -> str:
    """An exception of a user's code with its location: `KeyError: 'gain' (mine.py:12, in update)`.

    The location is the innermost line in the user's files. These are the files in the folder of the
    first file that belongs neither to estbench nor to its dependencies. Without such a file the
    location is left out. A syntax error names its own location.
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
