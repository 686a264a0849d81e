"""Names of users, models and files as they may be shown: nothing in them steers the terminal."""

import unicodedata

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
