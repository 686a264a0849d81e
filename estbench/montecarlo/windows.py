"""A batch of long runs: truth, bound and every estimator go on together, window after window."""

from collections.abc import Callable, Sequence
from dataclasses import replace

from estbench.bounds import scenario as bounds
from estbench.bounds.passing import PassingBound
from estbench.consistency.fields import Record
from estbench.consistency.windows import Windows
from estbench.experiment import long, recording
from estbench.experiment.prepared import Setup
from estbench.simulation.sources import Passing


def run_batch(
    prepared: Setup, runs: Sequence[int], stop: Callable[[], bool] = lambda: False
) -> dict[str, Record] | None:
    """The record of every estimator on some long runs (`long.windowed`); None when stopped."""
    truth = Passing(recording.driven(prepared, runs), long.WINDOW)
    bound = PassingBound(prepared, runs, truth.x0) if bounds.wanted(prepared) else None
    sample, section = long.sampled(prepared, "summary"), prepared.scenario.consistency
    times, labels = prepared.times, prepared.scenario.estimators
    found = {label: Windows(times, section, sample) for label in labels}
    going = {
        label: recording.in_windows(prepared, label, runs, truth, long.WINDOW, stop=stop)
        for label in labels
    }
    while not all(windows.finished for windows in found.values()):
        happened = truth.forward(stop)
        if happened is None:
            return None
        values = None if bound is None else bound.forward(happened)
        for label, windows in found.items():
            traces = next(going[label], None)
            if traces is None:
                return None
            windows.add(replace(traces, bound=values))
    return {label: windows.record(truth.ended) for label, windows in found.items()}
