"""Which motion would show what the present one does not: other starts, held controls."""

from dataclasses import replace

import numpy as np

from estbench.bounds.expectation import Reading
from estbench.bounds.scenario import true_model, true_system
from estbench.experiment.prepared import Setup
from estbench.shapes import Array, Float
from estbench.spaces.linalg import quiet
from estbench.suites.along import Motion, labels

SPEED = 1.0
"""Of each start with a velocity, in its unit."""
ANGLE = 0.5
"""Of each start that is turned, rad."""
SHARE = 0.1
"""Of the range of a control by which it is moved, or 1 where it has no range."""
LONGEST = 200
"""Steps of each motion."""


def tried(setup: Setup) -> tuple[tuple[str, ...], Motion]:
    """Short motions without noise from the start of an experiment, each a run; and what they are.

    The first is that of the robot left to itself.
    """
    plant, space = setup.plant, setup.space
    nv = plant.model.nv
    start, names, states = setup.mean, ["the robot left to itself"], [setup.mean]
    controls = [plant.u0]
    angles = [j for j in range(nv) if space.units[j] == "rad"]
    for j, size in [*((nv + j, SPEED) for j in range(nv)), *((j, ANGLE) for j in angles)]:
        delta = np.zeros(space.n)
        delta[j] = size
        names.append(f"a start with {space.names[j]} = {size:g} {space.units[j]}")
        states.append(space.plus(start, delta))
        controls.append(plant.u0)
    limited = plant.model.actuator_ctrllimited.astype(bool)
    low, high = plant.model.actuator_ctrlrange.T
    for j in range(plant.model.nu):
        push = plant.u0.copy()
        push[j] += SHARE * (high[j] - low[j]) if limited[j] else 1.0
        names.append(f"control {j} held at {push[j]:.3g}")
        states.append(start)
        controls.append(push)
    instants = setup.instants[:LONGEST]
    x = [np.stack(states)]
    held = np.stack(controls)
    model = true_model(setup, {})
    with quiet():
        for instant in instants:
            dt = instant.end - instant.start
            x.append(model.transition(x[-1], held, instant.start, dt))
    u = np.broadcast_to(held, (len(instants), *held.shape))
    known = setup.scenario.model_copy(update={"bound": setup.scenario.bound or True})
    system, root = true_system(replace(setup, scenario=known), range(len(names)))
    root = root[:, root.any(axis=0)]
    read = [Reading(k, k, i.channels) for k, i in enumerate(instants, 1) if i.channels]
    times = setup.times[: len(instants) + 1]
    return tuple(names), Motion(system, *labels(setup), root, times, np.stack(x), u, read)


def kept(
    information: Float[Array, "run r r"], direction: Float[Array, " r"]
) -> Float[Array, " run"]:
    """What is left of the standard deviation along a direction, in each motion; NaN if it failed.

    Args:
        information: gathered in each motion.
        direction: of length 1, in units of the prior's standard deviations.
    """
    good = np.isfinite(information).all(axis=(-2, -1))
    out = np.full(len(information), np.nan)
    values, vectors = np.linalg.eigh(information[good])
    along: Array = (vectors.mT @ direction) ** 2
    out[good] = np.sqrt((along / (1.0 + np.maximum(values, 0.0))).sum(axis=-1))
    return out
