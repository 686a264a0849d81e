"""Coordinates that are held by their damping: bases and joints that a model fixes by a huge one."""

import mujoco
import numpy as np

from estbench.shapes import Bool, Mask

FACTOR = 1e4
"""Damping times timestep, in the coordinate's own inertia, from which on it is held."""
REST = 1e-10
"""Share of the usual noise density that is left to a held velocity: contacts and joints press on
it, and a filter that takes it for exactly zero is wrong by a few µm/s."""


def held(model: mujoco.MjModel) -> Bool[Mask, " nv"]:
    """Coordinates whose damping leaves less than 1e-4 of a velocity after one physics step.

    v⁺ = v / (1 + h d / M) with implicit damping d. A noise on such a velocity would be a force that
    no robot withstands (bases that are held by a damping of 1e11).
    """
    return np.asarray(model.dof_damping * model.opt.timestep > FACTOR * model.dof_M0)


def note(model: mujoco.MjModel, names: tuple[str, ...]) -> str:
    """What is assumed of them, in a line.

    Args:
        model: the robot.
        names: of its tangent coordinates.
    """
    listed = ", ".join(np.array(names)[: model.nv][held(model)].tolist())
    return (
        f"{listed}: the damping stops any motion within a physics step, so the velocity is "
        "believed to be zero"
    )
