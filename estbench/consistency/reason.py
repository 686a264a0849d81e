"""The line after the verdict's word: what failed, where, when and by how much."""

from collections.abc import Callable, Sequence

import numpy as np

from estbench.consistency.blocks import Block, span
from estbench.consistency.hypotheses import Hypothesis, Kind
from estbench.consistency.verdict import (
    BIASES,
    INNOVATIONS,
    MANY,
    Judgement,
    Verdict,
    above,
    bounds,
    sizes,
)

MOST = 3
"""Clauses in a line."""
APART = (Kind.NEES_SIZE, Kind.NEES_RUNS, Kind.COORDINATE_SIZE, Kind.NEES_ALONG)
"""Kinds that find what is right on average: they are named where they are worse than the others."""
STANDS_OUT = 1.25
"""A coordinate is named beside NEES/n if its ratio is at least so many times as far off."""


def reason(
    j: Judgement, names: Sequence[str], channels: Sequence[str], blocks: Sequence[Block],
    tolerance: float = 0.1, failed_at: float = 0.0, phases: Sequence[str] = (),
    rows: str = "runs",
) -> str:  # fmt: skip
    """One line, such as `overconfident: pole.vel, 2.1 x its variance, from 0.0 to 0.4 s`.

    Args:
        j: the judgement.
        names: of the coordinates.
        channels: their names.
        blocks: of time.
        tolerance: of the judgement.
        failed_at: when the simulation of a truth failed first, s.
        phases: of contact, such as `in flight`.
        rows: what the hypotheses are averages over.
    """
    clauses = [
        _clause("overconfident", _size(j, True, names, blocks, phases)),
        _clause("biased", _bias(j, names, blocks)),
        _clause("conservative", _size(j, False, names, blocks, phases)),
        _clause("overconfident innovations", _innovations(j, True, channels, blocks)),
        _clause("conservative innovations", _innovations(j, False, channels, blocks)),
        _clause("correlated innovations", _whiteness(j)),
    ]
    said = [c for c in clauses if c][:MOST]
    of = j.lost + j.runs + j.copies
    if j.lost:
        lost = f"{j.lost} of {of} runs diverged ({j.lost / of:.1%})"
        said = [lost, *said] if j.verdict is Verdict.DIVERGING else [*said, lost]
    if j.failed:
        failed = (
            f"the simulation of the truth failed in {j.failed} of {of + j.failed} runs, first at "
            f"{failed_at:g} s (MuJoCo: BADQPOS, BADQVEL or BADQACC)"
        )
        if j.verdict is Verdict.SIMULATION_FAILED:
            said = [f"{failed}; use a smaller model.timestep, process noise or initial.std", *said]
        else:
            said.append(failed)
    if j.verdict is Verdict.UNDECIDED:
        said.insert(0, _undecided(j, names, blocks, phases, tolerance, rows))
    if j.copies:
        said.append(f"{j.copies} runs are copies of others and were left out")
    if j.lacking:
        said.append(f"not tested, as the store is of an earlier version: {', '.join(j.lacking)}")
    return "; ".join(said)


def _clause(word: str, text: str) -> str:
    return f"{word}: {text}" if text else ""


def _effect(h: Hypothesis) -> float:
    """How far off an estimate is; of ratios the logarithm."""
    return abs(float(np.log(max(h.mean.value, 1e-300)))) if h.ideal else abs(h.mean.value)


def _times(x: float) -> str:
    return f"{x:.2g}" if 1e-3 <= x < 100 else f"{x:.0f}" if 100 <= x < 1e5 else f"{x:.1e}"


def _where(
    j: Judgement, kind: Kind, coordinate: int | None, side: Callable[[Hypothesis], bool],
    blocks: Sequence[Block],
) -> tuple[float, str] | None:  # fmt: skip
    """Mean and time of the blocks around the worst one, if at most half of the blocks fail."""
    every = {h.block or 0: h for h in j.hypotheses
             if h.kind is kind and h.coordinate == coordinate}  # fmt: skip
    failing = {h.block or 0 for h in j.refuted
               if h.kind is kind and h.coordinate == coordinate and side(h)}  # fmt: skip
    if not failing or 2 * len(failing) > len(every):
        return None
    first = last = max(failing, key=lambda b: _effect(every[b]))
    failing = {b for b in failing if above(every[b]) == above(every[first])}
    while first - 1 in failing:
        first -= 1
    while last + 1 in failing:
        last += 1
    value = float(np.mean([every[b].mean.value for b in range(first, last + 1)]))
    return value, f", {span(blocks[first : last + 1])}"


def _worst_coordinate(
    j: Judgement, whole: Kind, part: Kind, side: Callable[[Hypothesis], bool],
    blocks: Sequence[Block],
) -> tuple[int, float, str] | None:  # fmt: skip
    """Coordinate, estimate and time of the coordinate that fails most."""
    found = [h for h in j.refuted if h.kind is whole and side(h)]
    found = found or [h for h in j.refuted if h.kind is part and side(h)]
    if not found:
        return None
    worst = max(found, key=_effect)
    assert worst.coordinate is not None
    value, when = _where(j, part, worst.coordinate, side, blocks) or (worst.mean.value, "")
    return worst.coordinate, value, when


def _size(
    j: Judgement, large: bool, names: Sequence[str], blocks: Sequence[Block], phases: Sequence[str]
) -> str:
    """What the errors are larger, or smaller, than their covariance in."""

    def side(h: Hypothesis) -> bool:
        return above(h) == large

    failing = [h for h in sizes(j.refuted) if side(h)]
    if not failing:
        return ""
    apart = [h for h in failing if h.kind in APART]
    others = [h for h in failing if h not in apart]
    if apart:
        h = max(apart, key=_effect)
        wide = [a for a in apart if a.kind in (Kind.NEES_SIZE, Kind.NEES_RUNS)]
        if wide and _effect(h) <= STANDS_OUT * max(map(_effect, wide)):
            h = max(wide, key=_effect)
        if _effect(h) > STANDS_OUT * max(map(_effect, others), default=0.0):
            return _which(h, names)
    whole = next((h for h in failing if h.kind is Kind.NEES), None)
    parts = []
    if whole is not None:
        parts.append(f"NEES/n {_times(whole.mean.value)}")
    worst = _worst_coordinate(j, Kind.COORDINATE, Kind.COORDINATE_BLOCK, side, blocks)
    if worst is not None:
        i, value, when = worst
        far = abs(np.log(max(value, 1e-300)))
        if whole is None or far > STANDS_OUT * _effect(whole):
            lead = "most in " if whole is not None else ""
            parts.append(f"{lead}{names[i]}, {_times(value)} x its variance{when}")
    near = _phase(j, side)
    if near is not None:
        lead = "most " if parts else "NEES/n "
        parts.append(f"{lead}{_times(near.mean.value)} {phases[near.place]}")
    if len(parts) < 2 and (whole is not None or worst is None):
        found = _where(j, Kind.NEES_BLOCK, None, side, blocks)
        if found is not None:
            what = "most" if whole is not None else "NEES/n"
            parts.append(f"{what} {_times(found[0])}{found[1]}")
    if not parts:
        h = max(others, key=_effect)
        when = f" {phases[h.place]}" if h.kind is Kind.NEES_PHASE else ""
        when = when or f", {span([blocks[h.block or 0]])}"
        parts.append(f"NEES/n {_times(h.mean.value)}{when}")
    return ", ".join(parts)


def _phase(j: Judgement, side: Callable[[Hypothesis], bool]) -> Hypothesis | None:
    """The phase of contact that fails most, if it stands out among the phases."""
    failing = [h for h in j.refuted if h.kind is Kind.NEES_PHASE and side(h)]
    if not failing:
        return None
    worst = max(failing, key=_effect)
    others = [_effect(h) for h in failing if h is not worst]
    return worst if _effect(worst) > STANDS_OUT * max(others, default=0.0) else None


def _which(h: Hypothesis, names: Sequence[str]) -> str:
    """What a hypothesis of `APART` is about, and by how much it is wrong."""
    if h.kind is Kind.NEES_ALONG:
        return f"NEES/n {_times(h.mean.value)} in combinations of coordinates: wrong correlations"
    size = "small" if h.place == 0 else "large"
    if h.coordinate is not None:
        return f"{names[h.coordinate]}, {_times(h.mean.value)} x its variance while this is {size}"
    what = "while its covariance is" if h.kind is Kind.NEES_SIZE else "in the runs with a"
    end = "" if h.kind is Kind.NEES_SIZE else " covariance"
    return f"NEES/n {_times(h.mean.value)} {what} {size}{end}"


def _bias(j: Judgement, names: Sequence[str], blocks: Sequence[Block]) -> str:
    def side(h: Hypothesis) -> bool:
        return h.kind in BIASES

    worst = _worst_coordinate(j, Kind.BIAS, Kind.BIAS_BLOCK, side, blocks)
    if worst is None:
        return ""
    i, value, when = worst
    return f"{names[i]} {value:+.2g} σ{when}"


def _innovations(
    j: Judgement, large: bool, channels: Sequence[str], blocks: Sequence[Block]
) -> str:
    failing = [h for h in j.refuted if h.kind in INNOVATIONS and above(h) == large]
    if not failing:
        return ""
    one = [h for h in failing if h.kind is Kind.CHANNEL]
    total = [h for h in failing if h.kind is Kind.NIS]
    every = len({h.channel for h in j.hypotheses if h.kind is Kind.CHANNEL})
    if one and (len(one) < every or not total):
        worst = max(one, key=_effect)
        assert worst.channel is not None
        return f"{channels[worst.channel]}, NIS/m {_times(worst.mean.value)}"
    if total:
        return f"NIS/m {_times(total[0].mean.value)}"
    worst = max(failing, key=_effect)
    return f"NIS/m {_times(worst.mean.value)}, {span([blocks[worst.block or 0]])}"


def _whiteness(j: Judgement) -> str:
    found = [h for h in j.refuted if h.kind is Kind.WHITENESS]
    if not found:
        return ""
    worst = max(found, key=_effect)
    return f"{worst.mean.value:+.2f} at lag {worst.place}"


def _undecided(
    j: Judgement, names: Sequence[str], blocks: Sequence[Block], phases: Sequence[str],
    tolerance: float, rows: str,
) -> str:  # fmt: skip
    """What is not shown, and how many runs would decide."""
    if not j.open:
        return f"{j.runs} {rows} that did not diverge give no interval"

    def lacks(h: Hypothesis) -> float:
        low, high = bounds(h, tolerance) or (0.0, 0.0)
        return max(low - h.mean.low, h.mean.high - high) / (high - low) if high > low else np.inf

    h = max(j.open, key=lacks)
    low, high = bounds(h, tolerance) or (0.0, 0.0)
    what = "NEES/n" if h.kind in (Kind.NEES, Kind.NEES_BLOCK, Kind.NEES_PHASE) else str(h.kind)
    if h.coordinate is not None:
        square = "mean square over its variance" if h.ideal else "mean error over σ"
        what = f"{names[h.coordinate]}, {square},"
    when = f" {span([blocks[h.block]])}" if h.block is not None else ""
    when = f" {phases[h.place]}" if h.kind is Kind.NEES_PHASE else when
    if high <= low:
        return f"not refuted; with tolerance {tolerance:g} nothing can be shown"
    runs = (
        f"about {j.needed} {rows} would decide" if j.needed else f"more than {MANY:,} {rows} needed"
    )
    if not np.isfinite(h.mean.high - h.mean.low):
        runs = f"more {rows} are needed"
    return (
        f"{what}{when} {_range(h.mean.low, h.mean.high)} is not within {low:.3g} to {high:.3g}; "
        f"{runs}"
    )


def _range(low: float, high: float) -> str:
    return f"[{low:.3g}, {high:.3g}]".replace("inf", "∞")
