"""A batch of long runs: truth, bound and every estimator go on together, window after window."""

from collections.abc import Callable, Sequence
from dataclasses import replace

from estbench.bounds import scenario as bounds
from estbench.bounds.passing import PassingBound
from estbench.consistency.fields import Record
from estbench.consistency.windows import Windows
from estbench.experiment import long, recording
from estbench.experiment.build import watched
from estbench.experiment.contact import PassingContacts
from estbench.experiment.prepared import Setup
from estbench.scenario.reference import LABEL
from estbench.simulation.sources import Passing


def run_batch(
    prepared: Setup, runs: Sequence[int], stop: Callable[[], bool] = lambda: False
) -> dict[str, Record] | None:
    """The record of every estimator on some long runs (`long.windowed`); None when stopped."""
    truth = Passing(recording.driven(prepared, runs), long.WINDOW)
    if prepared.reference is not None:
        truth.reference = recording.in_windows(
            prepared.reference, LABEL, runs, truth.robots, long.WINDOW, stop=stop
        )
    bound = PassingBound(prepared, runs, truth.x0) if bounds.wanted(prepared) else None
    sample, section = long.sampled(prepared, "summary"), prepared.scenario.consistency
    times, labels = prepared.times, prepared.scenario.estimators
    found = {label: Windows(times, section, sample) for label in labels}
    going = {
        label: recording.in_windows(prepared, label, runs, truth, long.WINDOW, stop=stop)
        for label in labels
    }
    contacts = None
    if watched(prepared.scenario, prepared.plant.model):
        contacts = PassingContacts(prepared, runs)
    first = 0
    while not all(windows.finished for windows in found.values()):
        if not truth.forward(stop):
            return None
        x, ahead, phases = truth.now.x, truth.ahead and truth.ahead.x, None
        values = None if bound is None else bound.forward(truth.now)
        if contacts is not None:
            count = len(x) + (0 if ahead is None else len(ahead) - 1)
            phases = contacts.forward(x, ahead, times[first : first + count])
        first += len(x) - 1
        for label, windows in found.items():
            traces = next(going[label], None)
            if traces is None:
                return None
            windows.add(replace(traces, bound=values), phases)
    return {label: windows.record(truth.ended, truth.lost) for label, windows in found.items()}
