"""The command line: the application, its commands, and the exit codes of errors.

Each command imports what it needs when it runs: `--help` answers at once.
"""

import io
import os
import re
import sys
from pathlib import Path
from typing import Annotated, Any, cast

import typer

from estbench import __version__
from estbench.commands import (
    budget,
    check,
    compare,
    control,
    design,
    explain,
    export,
    leaderboard,
    new,
    observability,
    replay,
    report,
    ros,
    run,
    sensitivity,
    sensors,
    sweep,
    tune,
)
from estbench.commands.shared import say
from estbench.errors import TRUST, EstbenchError, Interrupted

app = typer.Typer(
    help="Which filter, with which sensors, on this robot, and can I trust its covariance?",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)

_UsageError = cast(type[typer.BadParameter], typer.BadParameter.mro()[1])
"""Base of what typer raises for a bad command line; typer exports no name for it."""


_NO_MEMORY = re.compile(
    "unknown exception|bad_alloc|allocate|new thread|map segment", re.IGNORECASE
)
"""How MuJoCo, numpy, the system's loader and Python say that there is no memory; a thread has a
stack of its own."""


def _version(wanted: bool) -> None:
    """Print the version and exit, if wanted."""
    if wanted:
        print(f"estbench {__version__}")
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_version, is_eager=True, help="show it and exit"),
    ] = False,
) -> None:
    """The options before a command."""


# In the order of `--help`.
for command in (
    new,
    run,
    replay,
    export,
    check,
    sensors,
    control,
    report,
    compare,
    leaderboard,
    sweep,
    tune,
    ros,
    explain,
    budget,
    sensitivity,
    observability,
    design,
):
    command.register(app)


def _trust(wanted: bool) -> None:
    """Set the environment variable, which the workers see too."""
    if wanted:
        os.environ[TRUST] = "1"


def _common(
    trust: Annotated[
        bool,
        typer.Option(
            "--trust",
            callback=_trust,
            expose_value=False,
            help="run the code that a scenario of somebody else names",
        ),
    ] = False,
) -> None:
    """The option that every command has."""  # fmt: skip


def _built() -> Any:
    """The application, each command with the options of `_common`."""
    template = typer.Typer(add_completion=False)
    template.command()(_common)
    shared = typer.main.get_command(template).params
    group: Any = typer.main.get_command(app)
    for command in group.commands.values():
        command.params += [p for p in shared if p.name == "trust"]
    return group


def main() -> None:
    """Entry point: a user's mistake is one line on stderr and exit code 2, never a traceback."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # an ASCII terminal has no σ
    _check_names()
    try:
        code = _built()(prog_name="estbench", standalone_mode=False)
    except EstbenchError as error:
        _complain(str(error))
        sys.exit(130 if isinstance(error, Interrupted) else 2)
    except _UsageError as error:
        # Without any argument typer has printed the help, and the message is empty.
        if message := error.format_message():
            help_ = f"; see {error.ctx.command_path} --help" if error.ctx else ""
            _complain(message.rstrip(".") + help_)
        sys.exit(2)
    except (KeyboardInterrupt, typer.Abort):
        sys.exit(130)
    except BrokenPipeError:
        os._exit(0)  # the reader of the output (head, less) has closed the pipe
    except Exception as error:
        if isinstance(error, MemoryError) or _NO_MEMORY.search(str(error)):
            _complain(_no_memory(error))
            sys.exit(2)
        if not isinstance(error, RuntimeError) or "MUJOCO_GL" not in str(error):
            raise
        # The import of MuJoCo failed.
        chosen = os.environ.get("MUJOCO_GL")
        _complain(f"MUJOCO_GL is {chosen!r}; use egl, osmesa, glfw or disable, or unset it")
        sys.exit(2)
    sys.exit(code)


def _no_memory(error: Exception) -> str:
    what = f" ({error})" if str(error) else ""
    return f"no memory{what}; take fewer --runs, --workers or estimators, or raise ulimit -v"


def _check_names() -> None:
    """Refuse names of files that the locale cannot read: MuJoCo and the store need their text."""
    for name in (str(Path.cwd()), *sys.argv[1:]):
        try:
            name.encode()
        except UnicodeEncodeError:
            shown = os.fsencode(name).decode(errors="replace")
            _complain(
                f"the locale cannot read the name {shown!a}; set PYTHONUTF8=1 or LC_ALL=C.UTF-8"
            )
            sys.exit(2)


def _complain(message: str) -> None:
    """Print an error message as one line on standard error."""
    say(f"estbench: {' '.join(message.split())}")
