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
    scenario, robot = prepared.scenario, prepared.plant.model
    section, seed = scenario.contact, scenario.simulation.seed
    if not watched(scenario, robot):
        return None
    drawn = [
        parameters.of_runs(robot, key, (draw.relative_std, draw.std), seed, runs)
        for key, draw in scenario.truth.draw.items()
    ]
    found = sensing(prepared).look(x, section.slip, drawn)
    events = phases.events(found.touching, found.slipping, found.limited)
    events &= np.isin(phases.EVENTS, section.events)
    touching, event = (np.asarray(seen.any(axis=-1)) for seen in (found.touching, events))
    window = section.steps * prepared.plant.period
    return Seen(touching, events, phases.phases(prepared.times, touching, event, window))
