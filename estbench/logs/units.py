"""Factors from the units of a log's columns to the SI units of the channels."""

import numpy as np

from estbench.errors import LogError, did_you_mean

FACTORS = {
    "": 1.0, "1": 1.0, "m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3,
    "rad": 1.0, "deg": np.pi / 180, "mrad": 1e-3, "rev": 2 * np.pi,
    "m/s": 1.0, "mm/s": 1e-3, "cm/s": 1e-2, "km/h": 1 / 3.6,
    "rad/s": 1.0, "deg/s": np.pi / 180, "rpm": 2 * np.pi / 60,
    "m/s^2": 1.0, "g": 9.80665, "mg": 9.80665e-3,
    "N": 1.0, "kN": 1e3, "N m": 1.0, "mN m": 1e-3, "T": 1.0, "uT": 1e-6, "G": 1e-4,
}  # fmt: skip
"""SI value of one unit."""


def factor(unit: str | None, key: str) -> float:
    """The SI value of a unit.

    Args:
        unit: its name; None for the SI unit.
        key: of the scenario, that names it.

    Raises:
        LogError: it is not known.
    """
    if unit is None:
        return 1.0
    if unit not in FACTORS:
        raise LogError(
            f"{key}.unit is '{unit}'{did_you_mean(unit, filter(None, FACTORS))}; or leave it out "
            "and give `scale`"
        )
    return FACTORS[unit]
