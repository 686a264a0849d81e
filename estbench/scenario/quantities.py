"""The numbers of a scenario file, each with the range that a robot can have, and its tables."""

from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

LARGEST = 1e15
"""Magnitude of a quantity in SI units; its inverse is the least, but for 0. Beyond it the squares,
which covariances hold, are lost to rounding."""
LONGEST = 1e9
"""s, some 30 years."""
SHORTEST_STEP = 1e-7
"""s; the physics of a robot needs no shorter timestep."""


def _within(largest: float) -> AfterValidator:
    """A check that a number is 0, or of a magnitude up to the largest and down to its inverse."""

    def check(value: float) -> float:
        if value and not 1 / largest <= abs(value) <= largest:
            raise ValueError(f"use 0 or a magnitude from {1 / largest:g} to {largest:g}")
        return value

    return AfterValidator(check)


def _covariance(value: list[list[float]]) -> list[list[float]]:
    """Refuse rows of unequal length, and entries beyond the squares of quantities.

    Those off the diagonal may be tiny.
    """
    if len({len(row) for row in value}) > 1:
        raise ValueError(
            f"rows of {', '.join(str(len(row)) for row in value)} entries; use a square matrix"
        )
    for i, row in enumerate(value):
        for j, x in enumerate(row):
            if abs(x) > LARGEST**2 or (i == j and 0 < abs(x) < LARGEST**-2):
                raise ValueError(
                    f"entry ({i}, {j}) is {x:g}; use 0 or a magnitude from {LARGEST**-2:g} to "
                    f"{LARGEST**2:g}"
                )
    return value


Number = Annotated[float, _within(LARGEST)]
Positive = Annotated[float, Field(gt=0), _within(LARGEST)]
NonNegative = Annotated[float, Field(ge=0), _within(LARGEST)]
Squared = Annotated[float, _within(LARGEST**2)]
PerName = Number | list[Number] | dict[str, Number]
PerNameSquared = Squared | list[Squared] | dict[str, Squared]
"""Of variances and spectral densities."""
Covariance = Annotated[list[list[float]], AfterValidator(_covariance)]
Duration = Annotated[float, Field(gt=0, le=LONGEST)]
Delay = Annotated[float, Field(ge=0, le=LONGEST)]
Timestep = Annotated[float, Field(gt=0, ge=SHORTEST_STEP, le=LONGEST)]
Factor = Annotated[float, Field(ge=1, le=LONGEST)]
Count = Annotated[int, Field(ge=1, le=2**31 - 1)]
Index = Annotated[int, Field(ge=0, le=2**31 - 1)]
Probability = Annotated[float, Field(ge=0, lt=1), _within(LARGEST)]
Row = Annotated[tuple[Duration, Positive], Field(strict=False)]
Schedule = Annotated[list[Row], Field(min_length=1)] | str
"""Rows (until s, factor), each up to its time; or `module:function`, a function of t that returns
one factor, one factor per axis, or the full covariance."""


class Section(BaseModel):
    """A table of the scenario file."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=True)
