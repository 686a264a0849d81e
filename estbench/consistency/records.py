"""What is kept of each batch of runs: the variables in memory and on disk, and how they merge.

`summary` (averages of each run, sums at each step) is enough for every table; `diagonal` adds the
traces, `full` the covariances and innovations.
"""

import numpy as np

from estbench.consistency import blocks
from estbench.consistency.coverage import SIGMAS
from estbench.consistency.fields import (
    EACH,
    PHASES,
    RUN,
    STEP,
    BatchTraces,
    Field,
    Record,
    Recorded,
    run_major,
)
from estbench.consistency.innovations import BLOCKS, NEEDED
from estbench.consistency.nees import diverged_runs
from estbench.consistency.statistics import COORDINATE, STATISTICS
from estbench.inference.lags import LAGS
from estbench.inference.traces import Traces
from estbench.scenario.schema import ConsistencySection
from estbench.shapes import Array, Bool, Float, Mask
from estbench.spaces.directions import COUNT

SUMMARY: dict[str, Recorded] = {
    **{name: variable for s in STATISTICS for name, variable in s.variables.items()},
    **{
        f"inside_{k}": Recorded(
            COORDINATE, "f8", f"share of the steps with |error| <= {k}σ",
            lambda b, i=i: b.inside(i),
        )
        for i, k in enumerate(SIGMAS)
    },
    "nees_by_block": Recorded(
        (*RUN, "block"), "f8", "average of NEES/n in each block of time",
        lambda b: b.in_blocks(b.normalized, b.judged),
    ),
    "nis_by_block": Recorded(
        (*RUN, "block"), "f8", "average of NIS/m over the updates in each block of time",
        lambda b: b.in_blocks(b.normalized_update, b.dof > 0),
    ),
    "nees_by_size": Recorded(
        (*RUN, "size"), "f8",
        "average of NEES/n where the covariance is below its median over the run, and elsewhere",
        lambda b: b.by_size(b.normalized),
    ),
    "scaled_square_by_size": Recorded(
        (*RUN, "size", "coordinate"), "f8",
        "average of (error/σ)² where σ is below its median over the run, and elsewhere",
        lambda b: b.coordinates_by_size(),
    ),
    "nees_along": Recorded(
        (*RUN, "direction"), "f8", "average of the square of the whitened error along directions",
        lambda b: b.along(),
    ),
    "phase_steps": Recorded(
        (*RUN, "phase"), "i8", "instants in flight, in stance and near an event of contact",
        lambda b: b.phase_steps(),
    ),
    "anees_by_phase": Recorded(
        (*RUN, "phase"), "f8", "average of NEES/n in each phase of contact",
        lambda b: b.in_phases(b.normalized, b.judged),
    ),
    "nees_around_contact": Recorded(
        (*RUN, "side"), "f8",
        "average of NEES/n before the first event of contact, and from it on",
        lambda b: b.around_contact(b.normalized),
    ),
    "anis_by_phase": Recorded(
        (*RUN, "phase"), "f8", "average of NIS/m over the updates in each phase of contact",
        lambda b: b.in_phases(b.normalized_update, b.dof > 0),
    ),
    "mse_by_phase": Recorded(
        (*RUN, "phase", "coordinate"), "f8",
        "average of the squared error in each phase of contact, (unit)²",
        lambda b: b.in_phases(b.square),
    ),
    "scaled_error": Recorded(
        (*RUN, "block", "coordinate"), "f8", "average of error/σ in each block of time",
        lambda b: b.in_blocks(b.scaled, b.uncertain),
    ),
    "scaled_square": Recorded(
        (*RUN, "block", "coordinate"), "f8", "average of (error/σ)² in each block of time",
        lambda b: b.in_blocks(b.scaled**2, b.uncertain),
    ),
    "channel_nis": Recorded(
        (*RUN, "channel"), "f8",
        "average of NIS/m of each channel, given those before it in the measurement",
        lambda b: b.channel_nis(),
    ),
    "gated": Recorded(
        RUN, "i8", "components of readings that the estimator's gate refused",
        lambda b: b.summed(b.traces.gated),
    ),
    "received": Recorded(
        RUN, "i8", "components of readings that arrived", lambda b: b.summed(b.traces.dof)
    ),
    "known": Recorded(
        COORDINATE, "f8", "share of the steps at which the coordinate is known exactly",
        lambda b: b.known,
    ),
    "rank": Recorded(
        RUN, "f8", "time average of the degrees of freedom of NEES",
        lambda b: b.average(b.traces.rank),
    ),
    "fault": Recorded(
        RUN, "u1", "why the run failed (estbench.estimators.beliefs.Fault), 0 = it did not",
        lambda b: b.traces.fault,
    ),
    "fault_step": Recorded(
        RUN, "i8", "instant of the failure, -1 = none", lambda b: b.traces.fault_step
    ),
    "late": Recorded(
        RUN, "i8", "readings that came after the window and were not fused",
        lambda b: b.traces.late,
    ),
    "lags": Recorded(
        (*RUN, "lag"), "f8", "sums of ν̃ₖ·ν̃ₖ₋ₗ, l = 0, 1, ..., of whitened innovations",
        lambda b: b.traces.lags,
    ),
    "lag_terms": Recorded(
        (*RUN, "lag"), "i8", "how many products of two numbers are in each",
        lambda b: b.traces.lag_terms,
    ),
    "count": Recorded(
        STEP, "i8", "runs in the sums below: those that did not diverge",
        lambda b: np.full((1, len(b.settled)), (~b.diverged).sum()),
    ),
    "nees_sum": Recorded(
        STEP, "f8", "sum over runs of NEES, not divided by n", lambda b: b.total(b.traces.nees)
    ),
    "rank_sum": Recorded(
        STEP, "i8", "sum over runs of the degrees of freedom of NEES",
        lambda b: b.total(b.traces.rank),
    ),
    "nis_sum": Recorded(
        STEP, "f8", "sum over runs of NIS, not divided by m", lambda b: b.nis_total()
    ),
    "dof_sum": Recorded(
        STEP, "f8", "sum over runs of the innovation's dimension", lambda b: b.total(b.dof)
    ),
    "square_sum": Recorded(
        (*STEP, "coordinate"), "f8", "sum over runs of the squared error, (unit)²",
        lambda b: b.total(b.square),
    ),
    "variance_sum": Recorded(
        (*STEP, "coordinate"), "f8", "sum over runs of the variance, (unit)²",
        lambda b: b.total(b.variance),
    ),
    "bound_sum": Recorded(
        (*STEP, "coordinate"), "f8",
        "sum over the runs with a bound of what each adds to that on the squared error, (unit)²",
        lambda b: b.total(np.where(b.bounded[..., None], b.bound, 0.0)),
    ),
    "bound_count": Recorded(STEP, "i8", "runs in it", lambda b: b.total(b.bounded)),
}  # fmt: skip
SIZES = {
    "lag": LAGS + 1, "block": blocks.COUNT, "size": 2, "direction": COUNT, "phase": len(PHASES),
    "side": 2, "part": BLOCKS, "one": 1,
}  # fmt: skip
"""Dimensions that are the same for all scenarios."""
COST = {
    "cpu_time": Recorded(
        RUN, "f8", "core time of predict and update, s",
        lambda b: np.full(b.runs, b.traces.cpu_time / b.runs),
    )
}  # fmt: skip
"""Measured, so not a function of the scenario: kept beside the store, not in it."""
DIAGONAL = {
    "estimate": Recorded((*EACH, "state"), "f8", "x̂", run_major("mean")),
    "error": Recorded((*EACH, "coordinate"), "f8", "x ⊖ x̂ in the tangent at x̂", run_major("error")),
    "std": Recorded(
        (*EACH, "coordinate"),
        "f8",
        "filter's standard deviation, 0 where the coordinate is known exactly",
        run_major("std"),
    ),
    "nees": Recorded(EACH, "f8", "NEES, not divided by n", run_major("nees")),
    "nees_dof": Recorded(
        EACH, "i8", "degrees of freedom of NEES: n, less what is known exactly", run_major("rank")
    ),
    "nis": Recorded(
        EACH, "f8", "NIS, not divided by m, NaN where nothing arrived", run_major("nis")
    ),
    "dof": Recorded(EACH, "i8", "dimension of the innovation", run_major("dof")),
}
FULL = {
    "cov": Recorded(
        (*EACH, "coordinate", "coordinate_"), "f8", "P in the tangent at x̂", run_major("cov")
    ),
    "innovation": Recorded(
        (*EACH, "reading"), "f8", "ν = y ⊖ ŷ, NaN where nothing was fused", run_major("innovation")
    ),
    "innovation_cov": Recorded(
        (*EACH, "reading", "reading_"), "f8", "S of what was fused together",
        run_major("innovation_cov"),
    ),
}  # fmt: skip
PER_RUN = {name: field for name, field in SUMMARY.items() if field.dims[0] == "run"}
SUFFIX = "_by_part"
PARTS = {
    f"{name}{SUFFIX}": Field(
        ("run", "part", *("one" if dim == "block" else dim for dim in field.dims[1:])),
        field.dtype, f"of a part of the run: {field.meaning}",
    )
    for name, field in PER_RUN.items()
} | {
    f"scaled_innovation{SUFFIX}": Field(
        ("run", "part", "reading"), "f8", "of a part of the run: average of ν/√S of each component"
    )
}  # fmt: skip
"""The sample of a log (`parts`); rows of `part` without readings are not used."""
INNOVATIONS = {
    f"innovation_{name}{SUFFIX}": Field(field.dims, field.dtype, f"{field.meaning}; short parts")
    for name in NEEDED
    if (field := PARTS[f"{name}{SUFFIX}"])
}
"""The variables of the judgement of innovations, of which the parts may be shorter."""
RESERVED = {
    "run", "time", "block", "phase", "coordinate", "coordinate_", "unit", "channel", "state",
    "reading", "reading_", "done", "truth",
}  # fmt: skip
"""Names in a store beside the estimators' groups, so that no estimator may have one of them."""
TRUTH = {"x": Field((*EACH, "state"), "f8", "true state")}


def fields(keep: str, live: bool = False) -> dict[str, Field]:
    """The variables of an estimator's group in a store.

    Args:
        keep: `summary`, `diagonal`, `full`, or `log`: all, and the sample of `parts`.
        live: whether the controller sees the estimate. Each estimator then has a truth of its own,
            kept in its group; otherwise one truth in the group `truth` serves all.
    """
    truth = TRUTH if live and keep != "summary" else {}
    return SUMMARY | _traces(keep) | truth | (PARTS | INNOVATIONS if keep == "log" else {})


def _traces(keep: str) -> dict[str, Recorded]:
    """The variables with a time axis for each run."""
    return {"summary": {}, "diagonal": DIAGONAL, "full": DIAGONAL | FULL, "log": DIAGONAL | FULL}[
        keep
    ]


def reduce(
    traces: Traces,
    times: Float[Array, " time"],
    section: ConsistencySection,
    keep: str,
    phases: Bool[Mask, "time run phase"] | None = None,
) -> Record:
    """The record of one batch.

    Args:
        traces: with all that `keep` asks for.
        times: s; index 0 is the prior and is left out of averages.
        section: burn-in and the definition of divergence.
        keep: as of `fields`.
        phases: phase of contact of each instant, where it is known.
    """
    window = divergence_window(times, section)
    normalized = traces.nees / np.maximum(traces.rank, 1)
    lost = diverged_runs(normalized, section.divergence_threshold, window)
    batch = BatchTraces(
        traces=traces,
        times=times,
        settled=(times > section.burn_in) & (times > 0),
        diverged=(traces.fault > 0) | lost,
        blocks=blocks.blocks(times, section.burn_in),
        phases=phases,
    )
    recorded = SUMMARY | COST | _traces(keep)
    return {name: variable.values(batch) for name, variable in recorded.items()}


def divergence_window(times: Float[Array, " time"], section: ConsistencySection) -> int:
    """Steps above the threshold after which a run has diverged: at least 1, at most all."""
    window = round(section.divergence_duration / np.diff(times).mean())
    return max(1, min(window, len(times)))


def merge(records: list[Record]) -> Record:
    """The summary of several batches: runs follow each other, sums have one row per batch."""
    return {name: np.concatenate([r[name] for r in records]) for name in SUMMARY | COST}
