"""Arguments, options and output that several commands share."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from estbench.errors import ExecutorError
from estbench.tables.names import visible


def _found(scenario: str) -> str:
    """The name of a scenario that there is: a mistyped one is refused before anything is loaded."""
    from estbench.scenario import files

    files.find(scenario)
    return scenario


Scenario = Annotated[
    str,
    typer.Argument(
        callback=_found, help="bundled name, scenario .toml, MJCF .xml, or a results folder"
    ),
]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="SECTION.KEY=VALUE", help="override the scenario; repeatable"),
]
Estimators = Annotated[
    list[str] | None,
    typer.Option("--estimator", "-e", help="name, label or package.module:Name; repeatable"),
]
Seed = Annotated[int | None, typer.Option(help="seed of all random numbers")]
Duration = Annotated[float | None, typer.Option(help="length of each run, s")]
Out = Annotated[Path | None, typer.Option(help="results folder; default results/SCENARIO-TIME")]
Resume = Annotated[bool, typer.Option(help="go on with --out: compute what is missing")]
Shard = Annotated[
    str | None, typer.Option(metavar="I/N", help="compute the I-th of N shares into one --out")
]
Address = Annotated[str | None, typer.Option(help="of the dask scheduler, tcp://...")]
Format = Annotated[str, typer.Option("--format", help="text, markdown, csv, latex or json")]
Coordinates = Annotated[
    list[str] | None,
    typer.Option("--coordinate", metavar="PATTERN", help="those shown; repeatable; default all"),
]
Json = Annotated[bool, typer.Option("--json", help="print JSON in place of tables")]


def console() -> Console:
    """Standard output: colour and full width on a terminal only; 100 columns elsewhere."""
    found = Console(highlight=False)
    return found if found.is_terminal else Console(highlight=False, width=100)


def check_plot(path: Path) -> None:
    """Refuse, before anything is computed, a figure that cannot be written."""
    from estbench.report.figures import paper
    from estbench.tables.destination import check_file

    paper.check_format(path)
    check_file(path)


def say(line: str) -> None:
    """Print one line on standard error at once; control characters in names become escapes."""
    print(visible(line), file=sys.stderr, flush=True)


def shares(text: str | None) -> tuple[int, int] | None:
    """`I/N` as a pair of integers.

    Raises:
        ExecutorError: the text has another form.
    """
    if text is None:
        return None
    numbers = text.split("/")
    if len(numbers) != 2 or not all(number.isdecimal() for number in numbers):
        raise ExecutorError(f"--shard is '{text}'; use I/N, e.g. 1/4")
    return int(numbers[0]), int(numbers[1])


@contextmanager
def destination(out: Path | None, name: str, continued: bool = False) -> Iterator[Path | None]:
    """The folder of the results: `--out`, or a new one in `results`.

    Args:
        out: given by the user.
        name: of the scenario.
        continued: whether the folder exists, so that only the user can name it.

    Yields:
        The folder; None where the user should have named it.
    """
    if out is not None or continued:
        yield out
        return
    from estbench.store import folders

    with folders.named(name) as folder:
        yield folder


@contextmanager
def progress(total: int, ends: bool = True) -> Iterator[Callable[[int, int], None]]:
    """A progress bar on a terminal, one line every ten seconds elsewhere; both on standard error.

    Args:
        total: count of runs.
        ends: whether all of them are computed; a rule may stop before.

    Yields:
        A function of the finished runs and of all runs.
    """
    most = "" if ends else "at most "
    if sys.stderr.isatty():
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (
            TextColumn(f"{{task.completed:.0f}} of {most}{{task.total:.0f}} runs"),
            BarColumn(),
            *([TimeRemainingColumn()] if ends else []),
        )
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task("runs", total=total)
            yield lambda done, total: bar.update(task, completed=done)
        return
    from estbench.tables.durations import duration

    began = last = time.monotonic()
    first: tuple[int, float] | None = None  # what came with it is not repeated: workers start

    def line(done: int, total: int) -> None:
        nonlocal first, last
        now = time.monotonic()
        first = first or (done, now)
        if now - last >= 10 or (done == total and now - began > 2):
            last, left = now, ""
            if ends and first[0] < done < total:
                rest = (now - first[1]) * (total - done) / (done - first[0])
                left = f", about {duration(rest)} left"
            say(f"{done} of {most}{total} runs, {duration(now - began)}{left}")

    yield line


def chosen(patterns: list[str] | None, names: tuple[str, ...]) -> list[int]:
    """The places of the names that match any of the patterns; all without patterns.

    Raises:
        ScenarioError: a pattern matches no name.
    """
    from estbench.spaces.patterns import expand

    if not patterns:
        return list(range(len(names)))
    hit = expand(dict.fromkeys(patterns, 1.0), names, "--coordinate")
    return [i for i, on in enumerate(hit) if on]
