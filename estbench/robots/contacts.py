"""Which bodies touch something, which contacts slip, and which joints are at a limit.

A copy of the robot has a contact sensor on each body that may touch something and a limit sensor on
each limited joint. They are read at recorded states, all runs of an instant together.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from estbench.robots import backend
from estbench.robots.compiling import compiled
from estbench.shapes import Array, Bool, Float, Int, Mask

_DATA = mujoco.mjtConDataField
_CONTACT = [
    (1 << int(_DATA.mjCONDATA_FOUND)) | (1 << int(_DATA.mjCONDATA_LINVEL)),
    1,  # of several contacts the deepest
    1,  # of each body one
]
_WIDTH = 4
"""Numbers of a contact sensor: the count of contacts, then the velocity in the contact's frame."""
_PREFIXES = {"body": "estbench touch ", "joint": "estbench limit "}


@dataclass(frozen=True, eq=False)
class Touches:
    """What a robot touches.

    Attributes:
        touching: whether each body has a contact.
        slipping: whether the deepest contact of each body slips.
        limited: whether each limited joint is at a limit.
    """

    touching: Bool[Mask, "time run body"]
    slipping: Bool[Mask, "time run body"]
    limited: Bool[Mask, "time run joint"]


@dataclass(frozen=True, eq=False)
class Contacts:
    """The robot with the sensors of `sensed`.

    Attributes:
        model: compiled.
        bodies, joints: names of those that are watched.
        columns: of `sensordata`, those of the bodies first.
    """

    model: mujoco.MjModel
    bodies: tuple[str, ...]
    joints: tuple[str, ...]
    columns: Int[NDArray[np.intp], " k"]

    @classmethod
    def of(cls, model: mujoco.MjModel) -> "Contacts":
        """Find the sensors of `sensed` in a compiled model."""
        sensors = [model.sensor(i) for i in range(model.nsensor)]
        found = {p: [s for s in sensors if s.name.startswith(p)] for p in _PREFIXES.values()}
        parts = [np.arange(s.dim[0]) + s.adr[0] for chosen in found.values() for s in chosen]
        bodies, joints = (tuple(s.name[len(p) :] for s in chosen) for p, chosen in found.items())
        columns = np.concatenate([*parts, np.zeros(0, np.intp)]).astype(np.intp)
        return cls(model, bodies, joints, columns)

    def look(
        self,
        x: Float[Array, "time run nx"],
        slip: float,
        varied: Iterable[tuple[str, int | slice, Array]] = (),
    ) -> Touches:
        """What the robots touch at recorded states; nothing where a state is NaN.

        A contact counts where MuJoCo makes a constraint of it: nearer than the margin of the geoms.

        Args:
            x: states.
            slip: m/s, the tangential speed from which on a contact slips.
            varied: field, index and values `(run, ...)` of parameters that differ between the runs.
        """
        sensing, runs = backend.create(self.model), x.shape[1]
        for field, index, values in varied:
            sensing.vary(runs, field, index, values)
        u, stage = np.zeros((runs, self.model.nu)), int(mujoco.mjtStage.mjSTAGE_VEL)
        read = np.stack([sensing.read(now, u, 0.0, stage, self.columns) for now in x])
        sensing.close()
        width = _WIDTH * len(self.bodies)
        found = read[..., :width].reshape(*x.shape[:2], -1, _WIDTH)
        touching = found[..., 0] > 0
        slipping = touching & (np.hypot(found[..., 2], found[..., 3]) >= slip)
        return Touches(touching, slipping, read[..., width:] < 0)


def sensed(spec: mujoco.MjSpec, bodies: Bool[Mask, " body"]) -> mujoco.MjSpec:
    """A copy of a robot's description with these sensors and no others.

    Args:
        spec: the description.
        bodies: which bodies get a contact sensor; see `colliding`.
    """
    spec = spec.copy()
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    model = compiled(spec)
    sensors, objects = mujoco.mjtSensor, mujoco.mjtObj
    for kind, elements, chosen, sensor, obj in (
        ("body", spec.bodies, bodies, sensors.mjSENS_CONTACT, objects.mjOBJ_BODY),
        (
            "joint",
            spec.joints,
            model.jnt_limited,
            sensors.mjSENS_JOINTLIMITPOS,
            objects.mjOBJ_JOINT,
        ),
    ):
        for element in [e for e in elements if chosen[e.id]]:
            element.name = element.name or f"{kind} {element.id}"
            made = spec.add_sensor(
                name=_PREFIXES[kind] + element.name, type=sensor, objtype=obj, objname=element.name
            )
            if kind == "body":
                made.intprm = _CONTACT
    return spec


def colliding(model: mujoco.MjModel) -> Bool[Mask, " body"]:
    """Which moving bodies may touch something, by the geoms' bits, pairs and exclusions."""
    body = model.geom_bodyid
    out = np.zeros(model.nbody, bool)
    if model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CONTACT) or not len(body):
        return out
    weld = model.body_weldid[body]
    bits = model.geom_contype[:, None] & model.geom_conaffinity
    may = ((bits | bits.T) != 0) & (weld[:, None] != weld)
    if not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT):
        parent = model.body_weldid[model.body_parentid[weld]]
        child = (parent[:, None] == weld) & (weld != 0)
        may &= ~(child | child.T)
    if model.nexclude:
        ends = np.minimum(body[:, None], body), np.maximum(body[:, None], body)
        may &= ~np.isin((ends[0] << 16) + ends[1], model.exclude_signature)
    may[model.pair_geom1, model.pair_geom2] = may[model.pair_geom2, model.pair_geom1] = True
    out[body[may.any(axis=1) & (weld != 0)]] = True
    return out
