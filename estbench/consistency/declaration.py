"""What a statistic is declared by: its names, its computation, its unit, and where it is shown."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from estbench.consistency.fields import Record, Recorded
from estbench.consistency.intervals import Interval
from estbench.shapes import Array, Bool, Float, Mask

Value = Interval | float | tuple[Interval, ...] | Float[Array, " n"]
"""An interval or a number; per coordinate, a tuple of intervals or an array."""
Place = Literal["run", "compare", "innovations", "board", "board_csv", "report"]
"""A table: of `run`, two of `compare`, the leaderboard, its CSV file, the report."""
Detail = Literal["full", "brief"]
"""The value with its interval, or the value alone."""
EVERYWHERE: Mapping[Place, Detail] = {
    "run": "full", "compare": "full", "board": "full", "board_csv": "full", "report": "full",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Sample:
    """The merged record of one estimator.

    Attributes:
        record: per-run arrays, as `records.merge` gives them.
        level: confidence of the intervals.
        steps: instants of each run, the prior not counted.
    """

    record: Record
    level: float
    steps: int

    @property
    def good(self) -> Bool[Mask, " run"]:
        """Which runs did not diverge."""
        return ~self.record["diverged"].astype(bool)

    def converged(self, name: str) -> Float[Array, "good ..."]:
        """A variable over the runs that did not diverge."""
        return self.record[name][self.good]

    def every(self, name: str) -> Float[Array, "run ..."]:
        """A variable over all runs, infinite where it is not finite."""
        values = self.record[name]
        return np.where(np.isfinite(values), values, np.inf)


@dataclass(frozen=True, eq=False)
class Statistic:
    """One statistic of an estimator's runs.

    Attributes:
        name: attribute of `Summary` that holds its value.
        heading: of its column.
        key: of its value in JSON; `rmse.median` is the key `median` in the object `rmse`. In CSV
            the name of the quantity.
        meaning: one line for the documentation.
        of: computes it.
        per: `run`: one value; `coordinate`: one for each coordinate of the error.
        unit: of the value; `[c]` is that of the coordinate.
        unit_key: appended to `key` in JSON where the unit is part of the name there.
        form: `interval`; `share`, an interval that is shown in percent; `number`, no interval.
        decimals: of a number; None shows three digits.
        ideal: its value for a consistent filter, if that is a constant.
        phrase: its name in a sentence; default the heading.
        note: what a caption says of it.
        all_runs: whether diverged runs count.
        places: the tables that show it, and how.
        headings: of its column in single tables, in place of `heading`.
        narrow: the heading where columns are scarce.
        optional: whether tables leave it out where no estimator has it.
        truth: whether it compares with the truth; tables leave it out where none is known.
        variables: what it needs in the store, by name; merged as `Field.dims` says.
    """

    name: str
    heading: str
    key: str
    meaning: str
    of: Callable[[Sample], Value]
    per: Literal["run", "coordinate"] = "run"
    unit: str = "1"
    unit_key: str = ""
    form: Literal["interval", "share", "number"] = "interval"
    decimals: int | None = None
    ideal: float | None = None
    phrase: str = ""
    note: str = ""
    all_runs: bool = False
    places: Mapping[Place, Detail] = field(default_factory=lambda: EVERYWHERE)
    headings: Mapping[Place, str] = field(default_factory=dict)
    narrow: str = ""
    optional: bool = False
    truth: bool = False
    variables: Mapping[str, Recorded] = field(default_factory=dict)

    @property
    def json_key(self) -> str:
        """The key in JSON and the column of the leaderboard's CSV file."""
        return f"{self.key}_{self.unit_key}" if self.unit_key else self.key

    def heading_in(self, place: Place) -> str:
        """The heading of its column in one table."""
        return self.headings.get(place, self.heading)
