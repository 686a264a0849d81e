"""Rules for causes that are inferred from the innovations and the errors."""

from collections.abc import Sequence

import numpy as np

from estbench.analysis.evidence import Evidence
from estbench.analysis.finding import Finding, Rule, above, below, sign
from estbench.consistency.blocks import span
from estbench.consistency.hypotheses import Hypothesis, Kind
from estbench.consistency.verdict import above as too_large
from estbench.scenario.believed import believed
from estbench.tables.quantity import quantity


def bias(e: Evidence) -> Finding | None:
    """The mean error is not zero, or the innovations of a channel with a bias stay correlated."""
    constant: dict[str, Hypothesis] = {}
    for h in (*e.refuted(Kind.BIAS), *e.refuted(Kind.BIAS_BLOCK)):
        assert h.coordinate is not None
        constant.setdefault(e.names[h.coordinate], h)
    drifting = _unknown_biases(e)
    lasting = drifting and sign(e.lag_one) > 0 and not below(e.nis) and e.persistence > 0.8
    if not constant and not lasting:
        return None
    parts = []
    if constant:
        named = (
            f"{name} {h.mean.value:+.2g} σ" + (f" {span([e.spans[h.block]])}" if h.block else "")
            for name, h in constant.items()
        )
        parts.append(f"the mean error of {', '.join(named)} is not zero")
    if lasting:
        parts.append(
            f"{', '.join(drifting)} has a bias that the filter does not know, and the innovations "
            f"stay correlated over ten readings (lag one {quantity(e.lag_one)})"
        )
    return Finding(
        "bias", "; ".join(parts),
        "the bias as a state (`bias_ekf`), or calibration of the sensor",
    )  # fmt: skip


def offset(e: Evidence) -> Finding | None:
    """The mean innovation of a component of a log is not zero."""
    found = sorted(e.refuted(Kind.INNOVATION), key=lambda h: -abs(h.mean.value))
    if not found:
        return None
    named = ", ".join(f"{e.components[h.coordinate or 0]} {h.mean.value:+.2g} σ" for h in found[:3])
    return Finding(
        "offset", f"the mean innovation of {named} is not zero",
        "the offset of the channel (`log.channels.NAME.offset`), or its bias as a state "
        "(`bias_ekf`); an axis with the wrong sign (`scale = -1`)",
    )  # fmt: skip


def outliers(e: Evidence) -> Finding | None:
    """NIS is beyond its 99.9% quantile far too often, while its median is nearly right.

    A median at the 80% quantile of chi-square is what R x 0.5 gives, with a tail of 20 times. A
    filter that follows a wrong reading has the opposite innovation next; with positively correlated
    ones the large come one after the other, as those of a Q that is too small for some states only.
    """
    if e.rare is None or e.rare[0] < 20 or e.rare[1] > 0.8 or sign(e.lag_one) > 0:
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
    correlated (Mehra 1970, IEEE Trans. Autom. Control 15). NIS/m tells the two of a pair apart, or
    NEES/n where NIS/m is not refuted.
    """
    lag, size = sign(e.lag_one), _size(e)
    if not lag and size < 0 and e.summary.truth and not below(e.nees):
        lag = -1  # white innovations of an infinite Q
    if not lag or not size:
        return None
    name, text, remedy = {
        (1, 1): ("Q too small", "Q is too small, or a force is not modelled",
                    "a larger Q (`filter.process_noise_scale`), or the force as a state"),
        (-1, -1): ("Q too large", "Q is too large: the filter trusts its model too little",
                      "a smaller Q (`filter.process_noise_scale`)"),
        (-1, 1): ("R too small", "R is too small", "a larger R of the channels named"),
        (1, -1): ("R too large", "R is too large", "a smaller R of the channels named"),
    }[lag, size]  # fmt: skip
    differs = _differences(e) if (lag, size) == (1, 1) else ""
    return Finding(
        name,
        f"{text}: NIS/m is {quantity(e.nis)}, the lag-one correlation {quantity(e.lag_one)}"
        f"{_channels(e)}{differs}",
        remedy,
    )


def unseen(e: Evidence) -> Finding | None:
    """NIS/m is right and the innovations are white, but the errors are too large."""
    nis_right = abs(e.nis.value - 1) < 0.05 and not above(e.nis)
    white = not sign(e.lag_one)
    large = any(map(too_large, e.refuted(Kind.NEES, Kind.COORDINATE)))
    if not large or not nis_right or not white:
        return None
    return Finding(
        "unseen",
        f"NEES/n is {quantity(e.nees)} though the innovations are right (NIS/m "
        f"{quantity(e.nis)}): the filter is overconfident in directions that the sensors hardly "
        f"see{_where(e)}",
        "a sensor for these coordinates, a larger Q on them, or a filter for stronger "
        "nonlinearity (`iekf`, `ukf`)",
    )


def _size(e: Evidence) -> int:
    """1 or -1 where the innovations, or else the errors, are larger or smaller than they should be.

    0 where the verdict refutes neither, or some are larger and others smaller.
    """
    for kind in (Kind.NIS, Kind.CHANNEL, Kind.NEES, Kind.COORDINATE):
        sides = {1 if too_large(h) else -1 for h in e.refuted(kind)}
        if sides:
            return sum(sides)
    return 0


def _worst(failing: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Ratios, those that are least like 1 first."""
    return sorted(failing, key=lambda h: -abs(np.log(max(h.mean.value, 1e-12))))


def _where(e: Evidence, most: int = 3) -> str:
    """The coordinates whose errors the verdict refutes."""
    named = [
        f"{e.names[h.coordinate or 0]} ({h.mean.value:.3g} x its variance)"
        for h in _worst(e.refuted(Kind.COORDINATE))
    ]
    rest = f" and {len(named) - most} more" if len(named) > most else ""
    return f"; worst in {', '.join(named[:most])}{rest}" if named else ""


def _channels(e: Evidence, most: int = 3) -> str:
    """The channels whose NIS the verdict refutes."""
    named = [
        f"{e.channels[h.channel or 0]} (NIS/m {h.mean.value:.3g})"
        for h in _worst(e.refuted(Kind.CHANNEL))
    ]
    return f"; channels {', '.join(named[:most])}" if named else ""


def _differences(e: Evidence) -> str:
    """The settings in which the filter's model differs from the true one."""
    section = believed(e.scenario, e.label)
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


INFERRED: Sequence[Rule] = (bias, offset, outliers, noise, unseen)
