"""Long runs: which are computed window after window, and of which instants sums are kept."""

from itertools import count

import numpy as np

from estbench.experiment.build import watched
from estbench.experiment.prepared import Setup
from estbench.shapes import Array, Float, Int, Ints

WHOLE = 32768
"""Instants up to which a run is held as a whole."""
WINDOW = 4096
"""Instants of a longer run that are held at once: a multiple of `inference.lags.BLOCK`."""
SAMPLE = 8192
"""Instants of a longer run, at most, that have sums over the runs of their own."""
LEAST = 11
"""From one of these instants to the next. It is a prime, so that no channel's period divides it."""


def windowed(setup: Setup, keep: str) -> bool:
    """Whether the memory of a run does not grow with its length.

    A run is held as a whole where something needs it: its traces are kept, an estimator looks back,
    the controller sees its estimate, or readings are late: the bound has to know which are on their
    way, and windows of the estimators would end before those of the phases of contact.

    Args:
        setup: the experiment.
        keep: what is stored of each run.
    """
    if keep != "summary" or len(setup.instants) <= WHOLE or setup.timeline is not None:
        return False
    scenario = setup.scenario
    if scenario.control.observe == "estimate":
        return False
    if any(hasattr(setup.estimator(label), "smooth") for label in scenario.estimators):
        return False
    watching = watched(scenario, setup.plant.model)
    if watching and scenario.contact.steps * setup.plant.nstep >= WINDOW:
        return False
    late = not all(c.timing.punctual for c in setup.channels)
    late |= any(setup.delays(label).window for label in scenario.estimators)
    return not ((scenario.bound or watching) and late)


def sampled(setup: Setup, keep: str) -> Int[Ints, " kept"]:
    """The times, by their index, that have sums over the runs: all, or those of a sample.

    Args:
        setup: the experiment.
        keep: what is stored of each run.
    """
    last = len(setup.instants)
    if not windowed(setup, keep):
        return np.arange(last + 1)
    return np.unique([*range(0, last + 1, _step(setup)), last])


def notices(setup: Setup, keep: str) -> list[str]:
    """What a summary of a long run leaves out."""
    if not windowed(setup, keep):
        return []
    return [
        f"a run of {len(setup.instants):,} instants: NEES, NIS and errors over time, and the "
        f"comparison by the covariance's size, are of every {_step(setup)}th instant; averages "
        "are of all"
    ]


def sampled_times(setup: Setup, keep: str) -> Float[Array, " kept"]:
    """These times, s."""
    return setup.times[sampled(setup, keep)]


def held_instants(setup: Setup, keep: str) -> int:
    """Times of a run whose traces are held at once: of a long one a window, and the sample."""
    kept = len(sampled(setup, keep))
    return kept + WINDOW + 1 if windowed(setup, keep) else kept


def _step(setup: Setup) -> int:
    """Instants from one of the sample to the next."""
    least = max(LEAST, -(-len(setup.instants) // SAMPLE))
    return next(p for p in count(least) if _prime(p))


def _prime(p: int) -> bool:
    return all(p % d for d in range(2, int(p**0.5) + 1))
