"""The statistics of one estimator: each declared once, with its computation.

The tables and the JSON of `estbench run`, all formats of `estbench compare`, the leaderboard, the
report and the captions under them are made from `STATISTICS`. To add a statistic: declare it here,
with the variable that it stores if it needs one, and the attribute of `Summary` that holds it; a
test then asks for its row in docs/statistics.md.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from estbench.consistency import efficiency
from estbench.consistency.declaration import EVERYWHERE, Place, Statistic
from estbench.consistency.fields import RUN, Recorded
from estbench.consistency.intervals import (
    Interval,
    mean_interval,
    positive_mean_interval,
    wilson,
)
from estbench.consistency.skewness import skewness_interval
from estbench.consistency.verdict import Judgement, Verdict
from estbench.shapes import Array, Float

COORDINATE = (*RUN, "coordinate")

ANEES = Statistic(
    name="anees",
    truth=True,
    heading="NEES/n",
    key="anees_over_n",
    meaning="mean over runs of the time-averaged NEES, divided by its degrees of freedom (n, less "
    "what is known exactly)",
    of=lambda s: positive_mean_interval(s.converged("anees"), s.level),
    ideal=1.0,
    variables={
        "anees": Recorded(
            RUN, "f8", "time average of NEES, over that of its degrees of freedom",
            lambda b: b.normalized_nees(),
        )
    },
)  # fmt: skip
ANEES_MEDIAN = Statistic(
    name="anees_median",
    truth=True,
    heading="median",
    key="anees_over_n_median",
    meaning="median over all runs of their time-averaged NEES/n",
    of=lambda s: float(np.median(s.every("anees"))),
    form="number",
    decimals=3,
    all_runs=True,
    places={"run": "brief", "compare": "brief", "board_csv": "brief", "report": "brief"},
)
ANIS = Statistic(
    name="anis",
    heading="NIS/m",
    key="anis_over_m",
    meaning="mean over runs of the NIS averaged over the updates, divided by m",
    of=lambda s: positive_mean_interval(s.converged("anis"), s.level),
    ideal=1.0,
    places={"run": "full", "compare": "full", "board_csv": "brief", "report": "full"},
    variables={
        "anis": Recorded(
            RUN, "f8", "time average of NIS/m over the updates", lambda b: b.normalized_nis()
        )
    },
)
LAG_ONE = Statistic(
    name="lag_one",
    heading="lag-one",
    key="innovation_lag_one",
    meaning="mean over runs of the lag-one correlation of the whitened innovations",
    of=lambda s: mean_interval(s.converged("lag_one"), s.level),
    ideal=0.0,
    decimals=3,
    phrase="the innovations' lag-one correlation",
    places={"run": "brief", "innovations": "full", "board_csv": "brief", "report": "full"},
    variables={
        "lag_one": Recorded(
            RUN, "f8", "lag-one correlation of the whitened innovations",
            lambda b: b.traces.lag_one,
        )
    },
)  # fmt: skip
LOG_LIKELIHOOD = Statistic(
    name="log_likelihood",
    heading="log-lik.",
    key="log_likelihood",
    meaning="mean over runs of the log-likelihood of all readings of a run",
    of=lambda s: mean_interval(s.converged("log_likelihood"), s.level),
    phrase="log-likelihood",
    note="log-lik.: of all readings of a run; larger is better, on the same readings only",
    places={"run": "brief", "innovations": "full", "board_csv": "brief", "report": "full"},
    variables={
        "log_likelihood": Recorded(
            RUN, "f8", "sum over the updates of the log-likelihood of the readings",
            lambda b: b.summed(b.traces.log_likelihood),
        )
    },
)  # fmt: skip
DIVERGED = Statistic(
    name="diverged_interval",
    heading="diverged",
    key="diverged_share",
    meaning="share of the runs that diverged, with Wilson's interval",
    of=lambda s: wilson(int((~s.good).sum()), len(s.good), s.level),
    form="share",
    all_runs=True,
    places={
        "run": "brief", "compare": "full", "board": "full", "board_csv": "full", "report": "brief",
    },
    variables={
        "diverged": Recorded(
            RUN, "?", "failed, or NEES/n above the threshold for the duration",
            lambda b: b.diverged,
        )
    },
)  # fmt: skip
RMSE = Statistic(
    name="rmse",
    truth=True,
    heading="RMSE",
    key="rmse",
    meaning="root of the mean over time and runs of the squared error",
    of=lambda s: tuple(
        positive_mean_interval(column, s.level).root() for column in s.converged("mse").T
    ),
    per="coordinate",
    unit="[c]",
    note="RMSE over time and the runs that did not diverge",
    places={"run": "brief", "board": "full", "board_csv": "full", "report": "full"},
    variables={
        "mse": Recorded(
            COORDINATE, "f8", "time average of the squared error, (unit)²",
            lambda b: b.average(b.square),
        )
    },
)  # fmt: skip
RMSE_MEDIAN = Statistic(
    name="rmse_median",
    truth=True,
    heading="median",
    key="rmse.median",
    meaning="median over all runs of the root of their time-averaged squared error",
    of=lambda s: np.sqrt(np.median(s.every("mse"), axis=0)),
    per="coordinate",
    unit="[c]",
    form="number",
    note="median is that of all runs",
    all_runs=True,
    places={"run": "brief"},
)
SIGMA = Statistic(
    name="std",
    heading="σ",
    key="rmse.sigma",
    meaning="root of the mean over time and runs of the variance that the filter reports",
    of=lambda s: np.sqrt(s.converged("variance").mean(axis=0))
    if s.good.any()
    else np.full(s.record["variance"].shape[1], np.nan),
    per="coordinate",
    unit="[c]",
    form="number",
    note="σ is what the filter reports",
    places={"run": "brief", "report": "brief"},
    variables={
        "variance": Recorded(
            COORDINATE, "f8", "time average of the filter's variance, (unit)²",
            lambda b: b.average(b.variance),
        )
    },
)  # fmt: skip
BOUND = {
    "bound": Recorded(
        COORDINATE, "f8",
        "time average of what the run adds to the bound on the mean square error, (unit)²",
        lambda b: b.average(b.bound),
    )
}  # fmt: skip
EFFICIENCY = Statistic(
    name="efficiency",
    truth=True,
    heading="efficiency",
    key="efficiency",
    meaning="n over the sum of mean square error / bound: 1 is the best possible",
    of=lambda s: efficiency.together(s.converged("bound"), s.converged("mse"), s.level),
    optional=True,
    variables=BOUND,
)
EFFICIENCY_EACH = Statistic(
    name="efficiency_each",
    truth=True,
    heading="efficiency",
    key="rmse.efficiency",
    meaning="bound on the mean square error over the mean square error",
    of=lambda s: efficiency.by_coordinate(s.converged("bound"), s.converged("mse"), s.level),
    per="coordinate",
    note="efficiency is the bound on the mean square error over it",
    places={"run": "brief", "compare": "full", "report": "brief"},
    optional=True,
    variables=BOUND,
)
MEAN_ERROR = Statistic(
    name="mean_error",
    truth=True,
    heading="mean error",
    key="mean_error",
    meaning="mean over time and runs of the error: the bias",
    of=lambda s: tuple(mean_interval(column, s.level) for column in s.converged("mean_error").T),
    per="coordinate",
    unit="[c]",
    ideal=0.0,
    places={"run": "full", "compare": "full", "report": "full"},
    narrow="mean\nerror",
    variables={
        "mean_error": Recorded(
            COORDINATE, "f8", "time average of the error, (unit)",
            lambda b: b.average(b.traces.error),
        )
    },
)  # fmt: skip
SKEW = Statistic(
    name="skew",
    truth=True,
    heading="skew",
    key="error_skewness",
    meaning="skewness of the error over time and runs, with the jackknife's interval",
    of=lambda s: tuple(
        skewness_interval(np.stack(columns, axis=-1), s.level)
        for columns in zip(*(s.converged(name).T for name in ("mean_error", "mse", "mean_cube")))
    ),
    per="coordinate",
    ideal=0.0,
    places={"run": "brief", "compare": "full", "report": "brief"},
    variables={
        "mean_cube": Recorded(
            COORDINATE, "f8", "time average of the cubed error, (unit)³",
            lambda b: b.average(b.traces.error**2 * b.traces.error),
        )
    },
)  # fmt: skip
COST = Statistic(
    name="cost",
    heading="µs/step",
    key="cost",
    meaning="time of one core for predict and update, per run and step",
    of=lambda s: 1e6 * float(s.record["cpu_time"].mean()) / s.steps,
    unit="us/step",
    unit_key="us_per_run_step",
    form="number",
    note="µs/step: of one core, per run",
    all_runs=True,
    places=dict.fromkeys(EVERYWHERE, "brief"),
)
STATISTICS: tuple[Statistic, ...] = (
    ANEES, ANEES_MEDIAN, ANIS, LAG_ONE, LOG_LIKELIHOOD, DIVERGED, EFFICIENCY, RMSE, RMSE_MEDIAN,
    SIGMA, EFFICIENCY_EACH, MEAN_ERROR, SKEW, COST,
)  # fmt: skip
"""In the order in which tables, JSON and CSV show them."""


@dataclass(frozen=True)
class Failure:
    """One run that failed.

    Attributes:
        run: its number.
        time: of the failure, s.
        reason: why.
    """

    run: int
    time: float
    reason: str


@dataclass(frozen=True, eq=False)
class Summary:
    """What is said of one estimator: one attribute for each of `STATISTICS`, and what follows.

    Attributes:
        label: the estimator's label.
        runs: how many runs.
        judgement: the verdict, and the hypotheses that it is made from.
        reason: what failed, where, when and by how much; one line, empty for a consistent filter.
        failures: the runs with a numerical failure.
        late: readings, of all runs, that came after the window and were not fused.
        known: share of the steps at which each coordinate was known exactly.
        rank: mean over time and runs of the degrees of freedom of NEES.
        gated: share of the components of all readings that the estimator's gate refused.
        truth: whether the truth is known, at least in part.
    """

    label: str
    runs: int
    judgement: Judgement
    reason: str
    anees: Interval
    anees_median: float
    anis: Interval
    lag_one: Interval
    log_likelihood: Interval
    diverged_interval: Interval
    efficiency: Interval
    rmse: tuple[Interval, ...]
    rmse_median: Float[Array, " n"]
    std: Float[Array, " n"]
    efficiency_each: tuple[Interval, ...]
    mean_error: tuple[Interval, ...]
    skew: tuple[Interval, ...]
    cost: float
    failures: tuple[Failure, ...]
    late: int = 0
    known: tuple[float, ...] = ()
    rank: float = np.nan
    gated: float = 0.0
    truth: bool = True

    @property
    def verdict(self) -> Verdict:
        """The verdict, in a word."""
        return self.judgement.verdict

    @property
    def diverged(self) -> float:
        """Share of the runs that diverged."""
        return self.diverged_interval.value


def of(per: Literal["run", "coordinate"]) -> list[Statistic]:
    """The statistics with one value, or those with one per coordinate, in order."""
    return [s for s in STATISTICS if s.per == per]


def shown(
    place: Place,
    per: Literal["run", "coordinate"] = "run",
    summaries: Sequence[Summary] | None = None,
) -> list[Statistic]:
    """The statistics of one table, in order.

    Args:
        place: the table.
        per: those with one value, or those with one for each coordinate.
        summaries: of its estimators; without an optional statistic that none of them has, and
            without those that need the truth where none of them has it.
    """
    found = [s for s in of(per) if place in s.places]
    if summaries is None:
        return found
    judged = any(summary.truth for summary in summaries)
    return [
        s
        for s in found
        if (judged or not s.truth)
        and (not s.optional or any(_has(summary, s) for summary in summaries))
    ]


def _has(summary: Summary, statistic: Statistic) -> bool:
    """Whether any value of a statistic is a number."""
    value = getattr(summary, statistic.name)
    each = value if statistic.per == "coordinate" else (value,)
    return any(np.isfinite(x.value if isinstance(x, Interval) else x) for x in each)


def ideals(place: Place, summaries: Sequence[Summary] | None = None) -> str:
    """`NEES/n and NIS/m are 1, ... is 0`: the values of a consistent filter, for a caption."""
    by_value: dict[float, list[str]] = {}
    for s in shown(place, summaries=summaries):
        if s.ideal is not None:
            by_value.setdefault(s.ideal, []).append(s.phrase or s.heading)
    return ", ".join(
        f"{' and '.join(names)} {'are' if len(names) > 1 else 'is'} {value:g}"
        for value, names in by_value.items()
    )
