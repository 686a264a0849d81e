"""The estimators of several variants on the same runs: one truth, one record each."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from estbench.bounds import scenario as bounds
from estbench.consistency import records
from estbench.consistency.fields import Record
from estbench.consistency.records import COST, SUMMARY
from estbench.errors import EstbenchError
from estbench.experiment import recording
from estbench.experiment.prepared import Setup
from estbench.simulation.sources import Trajectory

KEPT = {name: f for name, f in {**SUMMARY, **COST}.items() if f.dims[0] == "run"}
"""The variables that a study keeps: those of each run."""

Outcome = Record | str
"""What an estimator gave: its record, or why it failed."""


def simulated(prepared: Setup, runs: Sequence[int]) -> Trajectory | None:
    """The truth and the readings of some runs; None where each estimator has its own truth."""
    if prepared.scenario.control.observe == "estimate":
        return None
    return recording.trajectory(prepared, runs)


def evaluate(
    variants: Sequence[Setup],
    runs: Sequence[int],
    truth: Trajectory | None,
    stop: Callable[[], bool] = lambda: False,
    bounded: bool = True,
) -> list[dict[str, Outcome]] | None:
    """Run every estimator of every variant.

    Args:
        variants: experiments with one truth and the same readings.
        runs: their numbers.
        truth: of these runs, from `simulated`.
        stop: asked at every instant; True ends it.
        bounded: whether to compute the bound of these runs, where the scenario wants it.

    Returns:
        For each variant, label -> record or the reason of a failure; None when stopped.
    """
    out: list[dict[str, Outcome]] = []
    bounded = bounded and bounds.wanted(variants[0])
    bound = None
    if bounded and truth is not None:
        bound = bounds.bound_of_runs(variants[0], runs, truth, stop)
    for prepared in variants:
        out.append({})
        for label in prepared.scenario.estimators:
            try:
                found = recording.estimated(prepared, label, runs, truth, stop=stop)
            except EstbenchError as error:
                out[-1][label] = str(error)
                continue
            if found is None:
                return None
            traces, own = found
            if bounded and truth is None:
                bound = bounds.bound_of_runs(prepared, runs, own, stop)
            traces = replace(traces, bound=bound)
            section = prepared.scenario.consistency
            full = records.reduce(traces, prepared.times, section, "summary")
            out[-1][label] = {name: full[name] for name in KEPT}
    return out


def failed(sizes: dict[str, int], runs: int) -> Record:
    """The record of an estimator that could not be run: every run diverged, no number known."""
    out: Record = {}
    for name, field in KEPT.items():
        shape = (runs, *(sizes[d] for d in field.dims[1:]))
        unknown = np.nan if field.dtype.startswith("f") else 0
        out[name] = np.full(shape, unknown, dtype=field.dtype)
    out["diverged"][:] = True
    out["fault_step"][:] = -1
    return out
