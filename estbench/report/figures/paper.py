"""The style of figures for papers, and how they are written to a file."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from estbench.errors import EstbenchError, MissingExtraError, StoreError

try:
    import matplotlib
    from matplotlib.figure import Figure
except ImportError:
    raise MissingExtraError("matplotlib", "plot") from None

WIDTHS = {1: 3.5, 2: 7.16}
"""Inches of one and of two columns (IEEE)."""
FORMATS = ("png", "pdf", "svg")
_STYLE: Any = {
    "font.size": 8, "axes.titlesize": 8, "axes.labelsize": 8, "legend.fontsize": 7.5,
    "xtick.labelsize": 7, "ytick.labelsize": 7, "axes.linewidth": 0.6, "lines.linewidth": 1.0,
    "axes.grid": True, "grid.linewidth": 0.4, "grid.color": "#dddddd", "axes.axisbelow": True,
    "axes.spines.top": False, "axes.spines.right": False, "pdf.fonttype": 42,
    "svg.hashsalt": "estbench", "axes.formatter.useoffset": False, "savefig.dpi": 200,
}  # fmt: skip


def check_format(path: Path) -> None:
    """Refuse a file whose suffix is no format of figures.

    Raises:
        EstbenchError: the format is unknown.
    """
    kind = path.suffix.lstrip(".").lower()
    if kind not in FORMATS:
        raise EstbenchError(f"--format '{kind}' is not known; use {', '.join(FORMATS)}")


def write(draw: Callable[[], Figure], path: Path) -> None:
    """Draw a figure in the style of papers into a file; its suffix is the format.

    Raises:
        EstbenchError: the format is unknown.
        StoreError: the file cannot be written.
    """
    check_format(path)
    with matplotlib.rc_context(_STYLE):
        figure = draw()
        plain = {"png": {"Software": None}, "pdf": {"CreationDate": None}, "svg": {"Date": None}}
        try:
            figure.savefig(path, metadata=plain[path.suffix.lstrip(".").lower()])
        except OSError as error:
            raise StoreError(f"{path} cannot be written: {error.strerror}; choose -o") from None
