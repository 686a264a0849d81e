"""The legs of a MuJoCo robot: its IMU, encoders and touch sensors, and the kinematics of its feet.

The foot is the site of its touch sensor. Its position and Jacobian come from MuJoCo: the columns of
the Jacobian are a × (s - c) for a hinge with axis a through c, and a for a slide.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from estbench.errors import ScenarioError
from estbench.models.legged import Legs
from estbench.robots import layout
from estbench.robots.backend import Backend
from estbench.shapes import Array, Bool, Float, Int, Ints, Mask

_FIELDS = ("site_xpos", "xanchor", "xaxis")


def find(
    model: mujoco.MjModel, sensors: Mapping[str, int], order: Sequence[str], backend: Backend
) -> Legs:
    """The legs of a robot.

    Args:
        model: compiled.
        sensors: channel -> its MuJoCo sensor, of the channels that are one whole sensor.
        order: all channels of a whole measurement.
        backend: of the model.

    Raises:
        ScenarioError: the robot has no floating base with one IMU, no touch sensor, or a joint
            without an encoder.
    """
    kinds = {
        kind: [name for name, i in sensors.items() if layout.sensor_type(model, i) == kind]
        for kind in ("gyro", "accelerometer", "jointpos", "touch")
    }
    for kind in ("gyro", "accelerometer", "touch"):
        found = kinds[kind]
        if not found or (kind != "touch" and len(found) > 1):
            wanted = "one for each foot" if kind == "touch" else "one"
            raise ScenarioError(
                f"the channels {', '.join(found) or 'none'} are of type {kind}; {wanted} is needed"
            )
    gyro, accelerometer = kinds["gyro"][0], kinds["accelerometer"][0]
    imu, other = (int(model.sensor_objid[sensors[name]]) for name in (gyro, accelerometer))
    base = int(model.site_bodyid[imu])
    first = int(model.body_jntadr[base])
    if imu != other or first < 0 or model.jnt_type[first] != layout.FREE:
        raise ScenarioError(
            f"{gyro} and {accelerometer} are not at one site of a body with a free joint; put both "
            "at a site of the floating base"
        )
    if model.na:
        raise ScenarioError("an actuator has an activation, which no sensor of this kind shows")
    encoders = {int(model.sensor_objid[sensors[name]]): name for name in kinds["jointpos"]}
    others = [j for j in range(model.njnt) if j != first]
    missing = [layout.object_name(model, mujoco.mjtObj.mjOBJ_JOINT, j, "joint") for j in others
               if j not in encoders]  # fmt: skip
    if missing:
        raise ScenarioError(f"no encoder on {', '.join(missing)}; add a jointpos channel for each")
    sites = [int(model.sensor_objid[sensors[name]]) for name in kinds["touch"]]
    qpos, dof = model.jnt_qposadr, model.jnt_dofadr
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, model.site_quat[imu])
    kinematics = _Kinematics(
        backend, np.array(others), _moves(model, sites, others), np.array(sites),
        model.jnt_type[others] == layout.SLIDE, int(qpos[first]), model.site_pos[imu].copy(),
        axes.reshape(3, 3),
    )  # fmt: skip
    return Legs(
        gyro,
        accelerometer,
        tuple(encoders[j] for j in others),
        tuple(kinds["touch"]),
        (int(qpos[first]), int(dof[first])),
        (model.nq + int(dof[first]), model.nv + int(dof[first])),
        np.stack([qpos[others], dof[others]], axis=1).astype(np.intp),
        np.stack([model.nq + dof[others], model.nv + dof[others]], axis=1).astype(np.intp),
        kinematics.offset,
        kinematics.axes,
        model.opt.gravity.copy(),
        float(model.body_subtreemass[0] * np.linalg.norm(model.opt.gravity)),
        kinematics.moves,
        tuple(order),
        kinematics,
        np.array([_radius(model, site) for site in sites]),
    )


@dataclass(frozen=True, eq=False)
class _Kinematics:
    """The feet in the frame of the IMU, all runs in one call of the backend."""

    backend: Backend
    joints: Int[Ints, " joint"]
    moves: Bool[Mask, "foot joint"]
    sites: Int[Ints, " foot"]
    slides: Bool[Mask, " joint"]
    root: int
    offset: Float[Array, " 3"]
    axes: Float[Array, "3 3"]

    def __call__(
        self, q: Float[Array, "run joint"]
    ) -> tuple[
        Float[Array, "run foot 3"],
        Float[Array, "run foot 3 joint"],
        Float[Array, "run foot 3 joint"],
    ]:
        """Positions s, and Jacobians of position and of orientation."""
        model = self.backend.model
        x = np.zeros((len(q), self.backend.nx))
        x[:, self.root + 3] = 1.0
        x[:, model.jnt_qposadr[self.joints]] = q
        site, anchor, axis = self.backend.frames(x, _FIELDS)
        site, anchor, axis = site[:, self.sites], anchor[:, self.joints], axis[:, self.joints]
        arm = site[:, :, None] - anchor[:, None]
        turn = np.cross(axis[:, None], arm)
        columns = np.where(self.slides[:, None], axis[:, None], turn)
        columns = np.where(self.moves[..., None], columns, 0.0)
        turns = np.where(self.moves[..., None] & ~self.slides[:, None], axis[:, None], 0.0)
        return (site - self.offset) @ self.axes, (columns @ self.axes).mT, (turns @ self.axes).mT


def _radius(model: mujoco.MjModel, site: int) -> float:
    """Radius of a spherical foot, a geom that collides and has the site at its centre; else 0."""
    body = int(model.site_bodyid[site])
    for geom in np.flatnonzero(model.geom_bodyid == body).tolist():
        collides = model.geom_contype[geom] or model.geom_conaffinity[geom]
        if collides and model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE:
            radius = float(model.geom_size[geom, 0])
            if np.linalg.norm(model.geom_pos[geom] - model.site_pos[site]) < 0.01 * radius:
                return radius
    return 0.0


def _moves(
    model: mujoco.MjModel, sites: Sequence[int], joints: Sequence[int]
) -> Bool[Mask, "foot joint"]:
    """Whether a joint is between the root and a site."""
    out = np.zeros((len(sites), len(joints)), bool)
    for i, site in enumerate(sites):
        body, chain = int(model.site_bodyid[site]), set()
        while body:
            chain.add(body)
            body = int(model.body_parentid[body])
        out[i] = np.isin(model.jnt_bodyid[list(joints)], list(chain))
    return out
