"""Units as text: those of squares and of spectral densities."""


def squared(unit: str) -> str:
    """`m²` for m, `m²/s²` for m/s, `N² m²` for N m."""
    above, slash, below = unit.partition("/")
    parts = (" ".join(f"{factor}²" for factor in part.split()) for part in (above, below))
    return slash.join(parts) if slash else next(parts)


def density(unit: str) -> str:
    """The unit of the spectral density of a rate of something: `m²/s` for m, `m²/s³` for m/s."""
    square = squared(unit)
    return f"{square[:-2]}s³" if square.endswith("/s²") else f"{square}/s"


def impulse_density(unit: str) -> str:
    """The unit of the spectral density of a force or a control: `N² s` for N."""
    return f"{squared(unit)} s"
