"""Colours that colour-blind readers can tell apart, the same in the page and on paper.

Source: M. Okabe & K. Ito, "Color Universal Design" (2008), without yellow, which is invisible on
white, and black, which is invisible on a dark page. Each colour has its own dashes, so that two
curves that coincide are both visible. 35 entries differ.
"""

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F7F7F")
DASHES = ("solid", "7px,3px", "2px,3px", "8px,3px,2px,3px", "14px,4px")
"""As plotly and SVG read them."""
LINES = ("-", (0, (4, 1.5)), (0, (1.2, 1.5)), (0, (5, 1.5, 1.2, 1.5)), (0, (9, 2)))
"""The same for matplotlib."""
GREY = "#808080"
EVENTS = {
    "touch-down": ("v", "triangle-down", "▼"),
    "lift-off": ("^", "triangle-up", "▲"),
    "slip": ("s", "square", "■"),
    "limit": ("x", "x", "✕"),
}
"""Kind of an event of contact -> its mark on a time axis: for matplotlib, for plotly, in text."""


def colour(index: int) -> str:
    """Colour of the entry with that index."""
    return COLOURS[index % len(COLOURS)]


def dash(index: int) -> str:
    """Plotly's dash of the entry with that index."""
    return DASHES[index % len(DASHES)]


def faint(index: int, alpha: float) -> str:
    """The entry's colour with an opacity, as CSS."""
    return rgba(colour(index), alpha)


def rgba(colour: str, alpha: float) -> str:
    """`#rrggbb` with an opacity, as CSS."""
    r, g, b = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({r},{g},{b},{alpha:g})"
