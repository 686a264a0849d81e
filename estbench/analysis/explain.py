"""What is wrong with an estimator: rules that each look for one fault in the evidence.

A rule is a function of the evidence. It answers with a sentence and what usually helps, or with
None. The rules for causes that show in the settings or at one time are asked first. Only if they
find nothing are those asked that infer a cause from the innovations: a wrong start, for instance,
leaves the innovations of a Q that is too small.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from estbench.analysis.evidence import Evidence
from estbench.consistency.blocks import span
from estbench.consistency.intervals import Interval
from estbench.tables.quantity import quantity

MARGIN = 0.1
"""A relative difference from 1 of NEES/n, NIS/m or (error/σ)² that is too small to explain."""
LAG = 0.01
"""A lag-one correlation that is too small to explain."""


@dataclass(frozen=True)
class Finding:
    """One fault that the evidence shows.

    Attributes:
        rule: its name.
        text: what is wrong, where and when.
        remedy: what usually helps.
    """

    rule: str
    text: str
    remedy: str


Rule = Callable[[Evidence], Finding | None]


def explain(evidence: Evidence) -> list[Finding]:
    """The faults that the evidence shows, the most specific first; one without a cause at least.

    A filter whose NEES/n, NIS/m, innovations and coordinates are as they should be has none.
    """
    found: list[Finding] = []
    for rules in (COUNTED, DIRECT, INFERRED, (unexplained,)):
        said = [finding for rule in rules if (finding := rule(evidence)) is not None]
        found += said
        if said and rules is not COUNTED:
            break
    return found


def above(i: Interval, centre: float = 1.0, margin: float = MARGIN) -> bool:
    """Whether the whole interval is above a value by more than a margin."""
    return bool(i.low > centre + margin)


def below(i: Interval, centre: float = 1.0, margin: float = MARGIN) -> bool:
    """Whether the whole interval is below a value by more than a margin."""
    return bool(i.high < centre - margin)


def lost(e: Evidence) -> Finding | None:
    """More than 5% of the runs diverged."""
    if e.summary.diverged <= 0.05:
        return None
    reasons = {f.reason for f in e.summary.failures}
    why = f": {'; '.join(sorted(reasons))}" if reasons else ""
    return Finding(
        "lost", f"{e.summary.diverged:.0%} of {e.summary.runs} runs diverged{why}",
        "a better start (`start.method = \"batch\"`, `start.inflate`), or a filter for stronger "
        "nonlinearity (ukf, iekf)",
    )  # fmt: skip


def too_late(e: Evidence) -> Finding | None:
    """Readings came after the window and were not fused."""
    if not e.summary.late:
        return None
    return Finding(
        "window", f"{e.summary.late} readings came later than filter.window and were not fused",
        "a longer `filter.window`",
    )  # fmt: skip


def latency(e: Evidence) -> Finding | None:
    """NEES/n is too high, and late readings are fused as if they were current."""
    belief = e.scenario.filter
    naive = e.scenario.estimators[e.label].get("delays", belief.delays) == "naive"
    wrong: dict[str, tuple[float, float]] = {}
    for name in e.channels:
        true = e.scenario.channels[name].latency if name in e.scenario.channels else None
        told = belief.channels[name].latency if name in belief.channels else None
        taken = 0.0 if naive else told
        if taken is not None and abs((true or 0.0) - taken) > 1e-9:
            wrong[name] = true or 0.0, taken
    if not wrong or not above(e.nees):
        return None
    shown = ", ".join(
        f"{name} is {true:g} s late and taken as {taken:g} s"
        for name, (true, taken) in wrong.items()
    )
    return Finding(
        "latency", f"{shown}; NEES/n is {quantity(e.nees)}{_where(e)}",
        'the true latency: `filter.delays = "exact"`, and no other `filter.channels.NAME.latency`',
    )  # fmt: skip


def start(e: Evidence) -> Finding | None:
    """NEES/n is wrong in the first blocks only: P₀ or x̂₀."""
    high = [above(i) for i in e.block_nees]
    low = [below(i) for i in e.block_nees]
    for wrong, word in ((high, "too small, or x̂₀ is wrong"), (low, "too large")):
        count = wrong.index(False) if False in wrong else len(wrong)
        if 0 < count <= len(wrong) // 2 and not any(wrong[count:]):
            return Finding(
                "start",
                f"P₀ is {word}: NEES/n is {quantity(e.block_nees[0])} at first, wrong "
                f"{span(e.spans[:count])} and {quantity(e.block_nees[-1])} at the end",
                "`start.inflate`, a right `start.offset`, or `start.method = \"batch\"`",
            )  # fmt: skip
    return None


def some_time(e: Evidence) -> Finding | None:
    """NEES/n is too high in some blocks that do not begin with the start."""
    high = [above(i) for i in e.block_nees]
    if high[0] or not any(high) or sum(high) > len(high) // 2:
        return None
    first = high.index(True)
    last = first + 1
    while last < len(high) and high[last]:
        last += 1
    worst = max(e.block_nees[first:last], key=lambda i: i.value)
    return Finding(
        "event",
        f"NEES/n is up to {quantity(worst)} {span(e.spans[first:last])} only: something happens "
        "then that the filter's model lacks (contact, saturation, a fault, a change of the noise)",
        "a filter for contact (`rotated_ukf`), a `schedule` of the noise, or a model of the event",
    )  # fmt: skip


def bias(e: Evidence) -> Finding | None:
    """The mean error is not zero, or the innovations of a channel with a bias stay correlated."""
    constant = [i for i, b in enumerate(e.bias) if abs(b.value) > MARGIN and _excludes_zero(b)]
    drifting = _unknown_biases(e)
    lasting = drifting and _sign(e.lag_one) > 0 and not below(e.nis) and e.persistence > 0.8
    if not constant and not lasting:
        return None
    parts = []
    if constant:
        named = (f"{e.names[i]} {e.bias[i].value:+.2g} σ" for i in constant)
        parts.append(f"the mean error of {', '.join(named)} is not zero")
    if lasting:
        parts.append(
            f"{', '.join(drifting)} has a bias that the filter does not know, and the innovations "
            f"stay correlated over ten readings (lag one {quantity(e.lag_one)})"
        )
    return Finding(
        "bias", f"{'; '.join(parts)}{_channels(e)}{_where(e)}",
        "the bias as a state (`bias_ekf`), or calibration of the sensor",
    )  # fmt: skip


def outliers(e: Evidence) -> Finding | None:
    """NIS is beyond its 99.9% quantile far too often, while its median is nearly right.

    A median at the 80% quantile of chi-square is what R x 0.5 gives, with a tail of 20 times.
    """
    if e.rare is None or e.rare[0] < 20 or e.rare[1] > 0.8:
        return None
    return Finding(
        "outliers",
        f"NIS is beyond its 99.9% quantile {e.rare[0]:.0f} times too often, and its median is at "
        f"the {e.rare[1]:.0%} quantile: single readings are wrong{_channels(e)}",
        "a robust filter (`robust_ekf`)",
    )  # fmt: skip


def noise(e: Evidence) -> Finding | None:
    """Size and lag-one correlation of the innovations tell Q from R.

    With Q too small or R too large the gain is too small, and the innovations are positively
    correlated; with Q too large or R too small the gain is too large, and they are negatively
    correlated (Mehra 1970, IEEE Trans. Autom. Control 15). NIS/m tells the two of a pair apart.
    """
    sign = _sign(e.lag_one)
    wide = [i for i in (e.nis, *e.channel_nis) if np.isfinite(i.value)]
    high = any(above(i) for i in wide)
    low = any(below(i) for i in wide) and not above(e.nis, margin=0.02)
    if not sign and low and not below(e.nees):
        sign = -1  # white innovations of an infinite Q
    if not sign or high == low:
        return None
    name, text, remedy = {
        (1, True): ("Q too small", "Q is too small, or a force is not modelled",
                    "a larger Q (`filter.process_noise_scale`), or the force as a state"),
        (-1, False): ("Q too large", "Q is too large: the filter trusts its model too little",
                      "a smaller Q (`filter.process_noise_scale`)"),
        (-1, True): ("R too small", "R is too small", "a larger R of the channels named"),
        (1, False): ("R too large", "R is too large", "a smaller R of the channels named"),
    }[sign, high]  # fmt: skip
    differs = _differences(e) if (sign, high) == (1, True) else ""
    return Finding(
        name,
        f"{text}: NIS/m is {quantity(e.nis)}, the lag-one correlation {quantity(e.lag_one)}"
        f"{_channels(e)}{_where(e)}{differs}",
        remedy,
    )


def unseen(e: Evidence) -> Finding | None:
    """NIS/m is right and the innovations are white, but NEES/n is too high."""
    nis_right = abs(e.nis.value - 1) < 0.05 and not above(e.nis)
    white = not _sign(e.lag_one)
    if not above(e.nees) or not nis_right or not white:
        return None
    return Finding(
        "unseen",
        f"NEES/n is {quantity(e.nees)} though the innovations are right (NIS/m "
        f"{quantity(e.nis)}): the filter is overconfident in directions that the sensors hardly "
        f"see{_where(e)}",
        "a sensor for these coordinates, a larger Q on them, or a filter for stronger "
        "nonlinearity (`iekf`, `ukf`)",
    )


def unexplained(e: Evidence) -> Finding | None:
    """Something is wrong, and no rule says what."""
    wrong = [
        f"{name} is {quantity(i)}"
        for name, i in (("NEES/n", e.nees), ("NIS/m", e.nis))
        if above(i) or below(i)
    ]
    if _sign(e.lag_one):
        wrong.append(f"the lag-one correlation is {quantity(e.lag_one)}")
    if not wrong:
        return None
    return Finding(
        "unexplained", f"{', '.join(wrong)}{_channels(e)}{_where(e)}; no cause is certain",
        "`estbench report` shows when and in which coordinates",
    )  # fmt: skip


COUNTED: Sequence[Rule] = (lost, too_late)
"""What is counted: it may have any cause, so the other rules are asked too."""
DIRECT: Sequence[Rule] = (latency, start, some_time)
"""Causes that show in the settings or at one time."""
INFERRED: Sequence[Rule] = (bias, outliers, noise, unseen)
"""Causes that are inferred from innovations and errors."""


def _sign(i: Interval) -> int:
    """1 or -1 where a correlation is above or below 0 and matters, else 0."""
    return int(np.sign(i.value)) if abs(i.value) > LAG and _excludes_zero(i) else 0


def _excludes_zero(i: Interval) -> bool:
    return bool(i.low > 0 or i.high < 0)


def _where(e: Evidence, most: int = 3) -> str:
    """The coordinates whose errors are least like their σ."""
    wrong = [
        (abs(np.log(max(i.value, 1e-12))), name, i.value)
        for name, i in zip(e.names, e.square)
        if above(i) or below(i)
    ]
    named = [f"{name} ({value:.3g} x its variance)" for _, name, value in sorted(wrong)[::-1]]
    rest = f" and {len(named) - most} more" if len(named) > most else ""
    return f"; worst in {', '.join(named[:most])}{rest}" if named else ""


def _channels(e: Evidence, most: int = 3) -> str:
    """The channels whose NIS is least like 1."""
    wrong = [
        (abs(np.log(max(i.value, 1e-12))), name, i.value)
        for name, i in zip(e.channels, e.channel_nis)
        if above(i) or below(i)
    ]
    named = [f"{name} (NIS/m {value:.3g})" for _, name, value in sorted(wrong)[::-1]]
    return f"; channels {', '.join(named[:most])}" if named else ""


def _differences(e: Evidence) -> str:
    """The settings in which the filter's model differs from the true one."""
    section = e.scenario.filter
    keys = [f"filter.set.{key}" for key in section.set]
    keys += [f"filter.{k}" for k in ("path", "timestep", "integrator") if getattr(section, k)]
    return f"; the filter's model differs in {', '.join(keys)}" if keys else ""


def _unknown_biases(e: Evidence) -> list[str]:
    """The channels that have a bias or a drift which the estimator does not have as a state."""
    settings = e.scenario.estimators[e.label]
    known = {
        str(key).split(".")[0] for key in (*settings.get("bias", ()), *settings.get("walk", ()))
    }
    return [
        name
        for name in e.channels
        if (section := e.scenario.channels.get(name)) is not None
        and name not in known
        and (
            section.bias_instability is not None
            or any(np.any(x) for x in (section.bias, section.bias_walk, section.drift))
        )
    ]
