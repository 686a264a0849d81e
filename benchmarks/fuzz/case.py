"""One input: how it is tried in a process of its own, and what came of it."""

import contextlib
import io
import multiprocessing
import os
import tempfile
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

from estbench.errors import EstbenchError

LIMIT = 60.0
"""s of wall time after which a case counts as a hang."""


@dataclass(frozen=True)
class Case:
    """A hostile input.

    Attributes:
        name: of the case, with what is wrong with it.
        call: tries it in the folder that it is given; returns a line about what was accepted.
        nonsense: whether it should be refused.
    """

    name: str
    call: Callable[[Path], str]
    nonsense: bool = False


@dataclass(frozen=True)
class Outcome:
    """What came of a case.

    Attributes:
        kind: `accepted`, `refused` (an error of estbench in one line), `traceback`, `died` (by a
            signal), or `hang`.
        text: what was said.
    """

    kind: str
    text: str


def attempt(case: Case) -> Outcome:
    """Try a case in a forked process."""
    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_child, args=(case, theirs))
    process.start()
    theirs.close()
    outcome = Outcome("hang", f"more than {LIMIT:g} s")
    try:
        if ours.poll(LIMIT):
            outcome = Outcome(*ours.recv())
    except EOFError:
        process.join()
        outcome = Outcome("died", f"exit code {process.exitcode}")
    process.kill()
    process.join()
    return outcome


def _child(case: Case, pipe: Connection) -> None:
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stderr(io.StringIO()):
        os.chdir(folder)
        try:
            kind, text = "accepted", case.call(Path(folder))
        except EstbenchError as error:
            text = str(error)
            kind = "refused" if len(text.splitlines()) <= 1 else "traceback"
        except BaseException:
            kind, text = "traceback", traceback.format_exc()
        os.chdir("/")
        pipe.send((kind, text))
        pipe.close()
