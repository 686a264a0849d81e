"""Geoms that overlap so deeply that their contact pushes the robot out of its pose."""

import mujoco
import numpy as np

from estbench.robots.feasible import DEEP
from estbench.robots.layout import object_name
from estbench.shapes import Array, Float, Int, Ints


def overlaps(model: mujoco.MjModel, x: Float[Array, " nx"]) -> dict[tuple[str, str], float]:
    """Two geoms -> the depth in m of their deepest contact, beyond `DEEP`, the deepest first.

    Contacts count of which MuJoCo makes a constraint. Collision meshes of neighbouring parts may
    overlap in every pose of the robot; if the MJCF does not exclude them, they push it away from
    the pose of the file.

    Args:
        model: the robot.
        x: its state.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = x[: model.nq]
    mujoco.mj_fwdPosition(model, data)
    contact, found = data.contact, dict[tuple[str, str], float]()
    for i in np.argsort(contact.dist, kind="stable"):
        if contact.dist[i] < -DEEP and contact.efc_address[i] >= 0:
            found.setdefault(_names(model, contact.geom[i]), -float(contact.dist[i]))
    return found


def note(found: dict[tuple[str, str], float]) -> str:
    """The deepest overlap, in a line."""
    (one, other), depth = next(iter(found.items()))
    others = len(found) - 1
    more = f" (and {others} more pair{'s' if others > 1 else ''})" if others else ""
    return (
        f"{one} and {other}{more} overlap at the start, by up to {1e3 * depth:.1f} mm: their "
        "contact pushes the robot out of its pose; exclude pairs that always overlap "
        "(<contact><exclude>), or start elsewhere"
    )


def _names(model: mujoco.MjModel, pair: Int[Ints, " 2"]) -> tuple[str, str]:
    """Of the geoms; `geom3` if the MJCF gives none."""
    geoms = [object_name(model, mujoco.mjtObj.mjOBJ_GEOM, int(i), "geom") for i in sorted(pair)]
    return geoms[0], geoms[1]
