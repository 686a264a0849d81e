"""A comparison as text, Markdown, LaTeX, CSV or JSON."""

import json

from estbench.analysis import numbers, shown
from estbench.analysis.compare import Comparison
from estbench.tables import formats


def render(comparison: Comparison, format_: str, width: int = 100) -> str:
    """The comparison in one of the formats of `tables.formats`."""
    return formats.render(
        format_,
        lambda: shown.build(comparison),
        lambda: numbers.to_csv(comparison),
        lambda: json.dumps(numbers.to_dict(comparison), indent=2, allow_nan=False),
        width,
    )
