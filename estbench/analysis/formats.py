"""A comparison as text, Markdown, LaTeX, CSV or JSON."""

import json

from estbench.analysis import numbers, shown
from estbench.analysis.compare import Comparison
from estbench.errors import AnalysisError, did_you_mean
from estbench.tables import writers

FORMATS = ("text", "markdown", "csv", "latex", "json")


def check(format_: str) -> None:
    """Check the format before any store is read.

    Raises:
        AnalysisError: there is no such format.
    """
    if format_ not in FORMATS:
        raise AnalysisError(f"no format '{format_}'{did_you_mean(format_, FORMATS)}")


def render(comparison: Comparison, format_: str, width: int = 100) -> str:
    """The comparison in one of `FORMATS`."""
    check(format_)
    if format_ == "json":
        return json.dumps(numbers.to_dict(comparison), indent=2, allow_nan=False)
    if format_ == "csv":
        return numbers.to_csv(comparison)
    built = shown.build(comparison)
    if format_ == "text":
        return writers.text(built, width)
    return writers.markdown(built) if format_ == "markdown" else writers.latex(built)
