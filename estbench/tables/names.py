"""Names of users, models and files as they may be shown: nothing in them steers what shows them."""

import unicodedata

from estbench.spaces.patterns import is_number

FORMULAS = ("=", "+", "-", "@", "\t", "\r")
"""First characters of a cell that a spreadsheet takes for a formula."""
UNSEEN = ("Cc", "Cf", "Zl", "Zp")
"""Unicode categories of characters that control a terminal or the direction of a text."""


def visible(text: str, lines: bool = False) -> str:
    r"""A text whose control characters are escapes, as `\x1b`.

    Args:
        text: a name, or a line with names in it.
        lines: whether line breaks remain.
    """
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        repr(c)[1:-1] if unicodedata.category(c) in UNSEEN and not (lines and c == "\n") else c
        for c in text
    )


def cell(value: object) -> object:
    """A value for a CSV file: a text that a spreadsheet would compute begins with a quote."""
    if not isinstance(value, str):
        return value
    quote = "'" if value.startswith(FORMULAS) and not is_number(value) else ""
    return quote + visible(value)
