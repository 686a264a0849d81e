"""What is kept of a batch of runs: named arrays with dimensions, the same in memory and on disk.

A record is a function of `Traces`; the summary (per-run averages, per-step sums) is enough for
every table, `diagonal` adds the traces to look at, `full` covariances and innovations.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estbench.consistency import coverage
from estbench.consistency.coverage import SIGMAS
from estbench.consistency.nees import diverged_runs
from estbench.inference.lags import LAGS
from estbench.inference.traces import Traces
from estbench.scenario.schema import ConsistencySection
from estbench.shapes import Array

Record = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Field:
    """Dimensions, type and meaning of one recorded array."""

    dims: tuple[str, ...]
    dtype: str
    meaning: str


RUN, STEP, EACH = ("run",), ("batch", "time"), ("run", "time")
SUMMARY = {
    "anees": Field(RUN, "f8", "time average of NEES/n"),
    "anis": Field(RUN, "f8", "time average of NIS/m over the updates"),
    "mse": Field((*RUN, "coordinate"), "f8", "time average of the squared error, (unit)²"),
    "variance": Field((*RUN, "coordinate"), "f8", "time average of the filter's variance, (unit)²"),
    "lag_one": Field(RUN, "f8", "lag-one correlation of the whitened innovations"),
    **{
        f"inside_{k}": Field((*RUN, "coordinate"), "f8", f"share of the steps with |error| <= {k}σ")
        for k in SIGMAS
    },
    "fault": Field(
        RUN, "u1", "why the run failed (estbench.estimators.beliefs.Fault), 0 = it did not"
    ),
    "fault_step": Field(RUN, "i8", "instant of the failure, -1 = none"),
    "diverged": Field(RUN, "?", "failed, or NEES/n above the threshold for the duration"),
    "late": Field(RUN, "i8", "readings that came after the window and were not fused"),
    "lags": Field((*RUN, "lag"), "f8", "sums of ν̃ₖ·ν̃ₖ₋ₗ, l = 0, 1, ..., of whitened innovations"),
    "lag_terms": Field((*RUN, "lag"), "i8", "how many products of two numbers are in each"),
    "count": Field(STEP, "i8", "runs in the sums below: those that did not diverge"),
    "nees_sum": Field(STEP, "f8", "sum over runs of NEES, not divided by n"),
    "nis_sum": Field(STEP, "f8", "sum over runs of NIS, not divided by m"),
    "dof_sum": Field(STEP, "f8", "sum over runs of the innovation's dimension"),
    "square_sum": Field((*STEP, "coordinate"), "f8", "sum over runs of the squared error, (unit)²"),
    "variance_sum": Field((*STEP, "coordinate"), "f8", "sum over runs of the variance, (unit)²"),
}
SIZES = {"lag": LAGS + 1}
"""Dimensions that are the same whatever the scenario."""
COST = {"cpu_time": Field(RUN, "f8", "core time of predict and update, s")}
"""Measured, so not a function of the scenario: kept beside the store, not in it."""
DIAGONAL = {
    "estimate": Field((*EACH, "state"), "f8", "x̂"),
    "error": Field((*EACH, "coordinate"), "f8", "x ⊖ x̂ in the tangent at x̂"),
    "std": Field((*EACH, "coordinate"), "f8", "filter's standard deviation"),
    "nees": Field(EACH, "f8", "NEES, not divided by n"),
    "nis": Field(EACH, "f8", "NIS, not divided by m, NaN where nothing arrived"),
    "dof": Field(EACH, "i8", "dimension of the innovation"),
}
FULL = {
    "cov": Field((*EACH, "coordinate", "coordinate_"), "f8", "P in the tangent at x̂"),
    "innovation": Field((*EACH, "reading"), "f8", "ν = y ⊖ ŷ, NaN where nothing was fused"),
    "innovation_cov": Field((*EACH, "reading", "reading_"), "f8", "S of what was fused together"),
}
RESERVED = {
    "run", "time", "coordinate", "coordinate_", "unit", "state", "reading", "reading_", "done",
    "truth",
}  # fmt: skip
"""What stands beside the estimators in a store, so that none may be called so."""
TRUTH = {"x": Field((*EACH, "state"), "f8", "true state")}


def fields(keep: str, live: bool = False) -> dict[str, Field]:
    """The fields an estimator's record has.

    With a controller that sees the estimate (`live`) each estimator has a truth of its own, kept in
    its own group; otherwise one truth in the group `truth` serves all.
    """
    traces = (DIAGONAL | (TRUTH if live else {})) if keep != "summary" else {}
    return SUMMARY | traces | (FULL if keep == "full" else {})


def reduce(traces: Traces, times: Array, section: ConsistencySection, keep: str) -> Record:
    """The record of one batch, run-major.

    Args:
        traces: time-major, `(K + 1, run, ...)`; with all that `keep` asks for.
        times: `(K + 1,)` s; index 0 is the prior and is left out of averages.
        section: burn-in and the definition of divergence.
        keep: `summary`, `diagonal` or `full`.
    """
    n = traces.error.shape[-1]
    settled = (times > section.burn_in) & (times > 0)
    step = np.diff(times).mean()
    window = round(section.divergence_duration / step)
    failed = traces.fault > 0
    diverged = failed | diverged_runs(traces.nees / n, section.divergence_threshold, window)
    good = ~diverged
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.where(traces.dof > 0, traces.nis / np.maximum(traces.dof, 1), 0.0)[settled[1:]]
        updates = (traces.dof[settled[1:]] > 0).sum(axis=0)
        anis = np.where(updates > 0, ratio.sum(axis=0) / np.maximum(updates, 1), np.nan)
    # A run whose every value is NaN has failed; NaN is the honest average.
    square, variance = traces.error**2, traces.std**2
    inside = coverage.inside(traces.error[settled], traces.std[settled])
    nis = np.concatenate([np.full((1, len(good)), np.nan), traces.nis])
    dof = np.concatenate([np.zeros((1, len(good)), np.int64), traces.dof])
    record: Record = {
        "anees": traces.nees[settled].mean(axis=0) / n,
        "anis": anis,
        "mse": square[settled].mean(axis=0),
        "variance": variance[settled].mean(axis=0),
        "lag_one": traces.lag_one,
        **{f"inside_{k}": inside[..., i] for i, k in enumerate(SIGMAS)},
        "fault": traces.fault,
        "fault_step": traces.fault_step,
        "diverged": diverged,
        "late": traces.late,
        "lags": traces.lags,
        "lag_terms": traces.lag_terms,
        "cpu_time": np.full(len(good), traces.cpu_time / len(good)),
        "count": np.full((1, len(times)), good.sum()),
        "nees_sum": traces.nees[:, good].sum(axis=1)[None],
        "nis_sum": np.nansum(nis[:, good], axis=1)[None],
        "dof_sum": dof[:, good].sum(axis=1)[None],
        "square_sum": square[:, good].sum(axis=1)[None],
        "variance_sum": variance[:, good].sum(axis=1)[None],
    }
    if keep != "summary":
        for name, value in (
            ("estimate", traces.mean), ("error", traces.error), ("std", traces.std),
            ("nees", traces.nees), ("nis", nis), ("dof", dof),
        ):  # fmt: skip
            record[name] = np.swapaxes(value, 0, 1)
    if keep == "full":
        for name in FULL:
            record[name] = np.swapaxes(getattr(traces, name), 0, 1)
    return record


def merge(records: list[Record]) -> Record:
    """The summary of several batches: runs one after the other, one row of sums a batch."""
    return {name: np.concatenate([r[name] for r in records]) for name in SUMMARY | COST}
