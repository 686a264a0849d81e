"""The contacts of the true robot in some runs: events and phases."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from estbench.consistency import phases
from estbench.experiment.build import watched
from estbench.experiment.prepared import Setup
from estbench.robots import contacts, mjcf, parameters
from estbench.robots.contacts import Contacts
from estbench.shapes import Array, Bool, Float, Mask


@dataclass(frozen=True, eq=False)
class Seen:
    """What the truth of some runs touches.

    Attributes:
        touching: whether the robot touches anything.
        events: which of the scenario's `contact.events` happen, in the order of `phases.EVENTS`.
        phases: the phase of each instant, in the order of `phases.PHASES`.
    """

    touching: Bool[Mask, "time run"]
    events: Bool[Mask, "time run kind"]
    phases: Bool[Mask, "time run phase"]

    def times(self, times: Float[Array, " time"], place: int) -> dict[str, Array]:
        """Kind -> times of the events of one run, s; of the kinds that happen.

        Args:
            times: of the instants, s.
            place: of the run in the batch.
        """
        found = self.events[:, place].T
        return {kind: times[at] for kind, at in zip(phases.EVENTS, found) if at.any()}


@lru_cache(maxsize=4)
def sensing(prepared: Setup) -> Contacts:
    """The true robot with sensors of contact."""
    section = prepared.scenario.model
    spec = mjcf.read(section.path)
    model = mjcf.compile_model(
        contacts.sensed(spec, contacts.colliding(prepared.plant.model)),
        timestep=section.timestep,
        settings=section.set,
    )
    return Contacts.of(parameters.changed(model, prepared.scenario.truth.set, "truth.set"))


def seen(prepared: Setup, x: Float[Array, "time run nx"], runs: Sequence[int]) -> Seen | None:
    """The contacts at the true states of some runs; None where the scenario has no phases.

    Args:
        prepared: the experiment.
        x: true states.
        runs: their numbers.
    """
    if not watched(prepared.scenario, prepared.plant.model):
        return None
    touching, events = looked(prepared, x, runs)
    event = np.asarray(events.any(axis=-1))
    found = phases.phases(prepared.times, touching, event, window(prepared))
    return Seen(touching, events, found)


def looked(
    prepared: Setup, x: Float[Array, "time run nx"], runs: Sequence[int]
) -> tuple[Bool[Mask, "time run"], Bool[Mask, "time run kind"]]:
    """`Seen.touching` and `Seen.events` at these states; no event is at the first."""
    scenario, robot = prepared.scenario, prepared.plant.model
    section, seed = scenario.contact, scenario.simulation.seed
    drawn = [
        parameters.of_runs(robot, key, (draw.relative_std, draw.std), seed, runs)
        for key, draw in scenario.truth.draw.items()
    ]
    found = sensing(prepared).look(x, section.slip, drawn)
    events = phases.events(found.touching, found.slipping, found.limited)
    events &= np.isin(phases.EVENTS, section.events)
    return np.asarray(found.touching.any(axis=-1)), events


def window(prepared: Setup) -> float:
    """Time before and after an event that belongs to it, s."""
    return prepared.scenario.contact.steps * prepared.plant.period


class PassingContacts:
    """The phases of contact of runs whose truth passes by, window after window.

    Args:
        prepared: the experiment.
        runs: their numbers.
    """

    def __init__(self, prepared: Setup, runs: Sequence[int]):
        self._prepared, self._runs = prepared, runs
        self._last = np.full(len(runs), -np.inf)  # time of the last event before the window
        self._event = np.zeros(len(runs), bool)  # at the last time of the window before
        self._now: tuple[Mask, Mask] | None = None

    def forward(
        self, x: Float[Array, "time run nx"], ahead: Array | None, times: Float[Array, " both"]
    ) -> Bool[Mask, "time run phase"]:
        """The phases of a window.

        Args:
            x: true states; the first are the last of the window before.
            ahead: those of the next window, which begins with the last of this one; None at the
                end of the run. It is longer than what belongs to an event.
            times: of both, s, in one.
        """
        touching, event = self._now or self._look(x, self._event)
        count, every = len(x), event
        if ahead is not None:
            self._now = self._look(ahead, event[-1])
            touching = np.concatenate([touching, self._now[0][1:]])
            every = np.concatenate([event, self._now[1][1:]])
        found = phases.phases(times, touching, every, window(self._prepared), self._last)
        seen = np.where(event, times[:count, None], -np.inf).max(axis=0)
        self._last, self._event = np.maximum(self._last, seen), event[-1]
        return found[:count]

    def _look(self, x: Array, first: Mask) -> tuple[Mask, Mask]:
        """Where the robots touch something, and where an event happens `(time, run)`."""
        touching, events = looked(self._prepared, x, self._runs)
        event = np.asarray(events.any(axis=-1))
        event[0] = first
        return touching, event
