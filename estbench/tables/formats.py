"""The formats in which a command prints its tables, and what each is made by."""

from collections.abc import Callable, Sequence

from estbench.errors import AnalysisError, did_you_mean
from estbench.tables import writers
from estbench.tables.columns import Table

FORMATS = ("text", "markdown", "csv", "latex", "json")


def check(format_: str) -> None:
    """Check the format before anything is read or computed.

    Raises:
        AnalysisError: there is no such format.
    """
    if format_ not in FORMATS:
        raise AnalysisError(f"no format '{format_}'{did_you_mean(format_, FORMATS)}")


def render(
    format_: str,
    tables: Callable[[], Sequence[Table]],
    csv: Callable[[], str],
    json: Callable[[], str],
    width: int = 100,
) -> str:
    """A result in one of `FORMATS`.

    Args:
        format_: its name.
        tables: what text, Markdown and LaTeX show.
        csv: the rows, as text.
        json: the numbers, as text.
        width: characters of a line of text.

    Raises:
        AnalysisError: there is no such format.
    """
    check(format_)
    if format_ == "json":
        return json()
    if format_ == "csv":
        return csv()
    built = tables()
    if format_ == "text":
        return writers.text(built, width)
    return writers.markdown(built) if format_ == "markdown" else writers.latex(built)
