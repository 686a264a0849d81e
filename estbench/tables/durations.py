"""Durations as text."""


def duration(seconds: float) -> str:
    """A duration in the unit in which it has two to four digits: `45 s`, `12 min`, `5.3 h`."""
    if seconds < 120:
        return f"{seconds:.2g} s" if seconds < 10 else f"{seconds:.0f} s"
    if seconds < 7200:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h" if seconds < 172_800 else f"{seconds / 86_400:.0f} days"
