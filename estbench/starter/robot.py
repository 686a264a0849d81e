"""What a first scenario needs to know of a robot: its base, joints, strength and inertia."""

from dataclasses import dataclass

import mujoco
import numpy as np

from estbench.errors import ScenarioError
from estbench.robots import backend, contacts, layout, mjcf
from estbench.robots.added_sensors import object_names
from estbench.shapes import Array, Bool, Float, Mask
from estbench.simulation.controllers import Plant

FILTER_PERIOD = 0.01
"""s; the filter's step is the multiple of the MJCF's timestep that is nearest to it."""
SETTLING = 2.0
"""s for which a robot without a keyframe is held before its pose is proposed as one."""
EARTH = 9.81


@dataclass(frozen=True, eq=False)
class Robot:
    """A compiled robot.

    Attributes:
        path: of the MJCF, as the scenario names it.
        spec: its editable model.
        plant: model, state space, nominal state and control.
        free: bodies with a free joint.
        base: the floating base, or the last link of a robot without one.
        touches: whether a geom of the robot may touch something.
    """

    path: str
    spec: mujoco.MjSpec
    plant: Plant
    free: tuple[str, ...]
    base: str
    touches: bool

    @classmethod
    def read(cls, path: str) -> "Robot":
        """The robot of an MJCF; `path` as for `mjcf.locate`.

        Raises:
            ScenarioError: it cannot be read or compiled, or has no joint.
        """
        spec = mjcf.read(path)
        model = mjcf.compile_model(spec)
        if not model.nv:
            raise ScenarioError(f"'{path}' has no joint: there is no state to estimate")
        x0, u0 = mjcf.keyframe(model, None)
        steps = max(1, round(FILTER_PERIOD / float(model.opt.timestep)))
        plant = Plant(model, layout.state_space(model), x0, u0, steps)
        names = object_names(model, "body")
        roots = model.jnt_bodyid[model.jnt_type == layout.FREE]
        largest = sorted(roots, key=lambda body: -_dofs_below(model, int(body)))
        free = tuple(names[body] for body in largest)
        base = free[0] if free else names[_last(model)]
        touches = bool(contacts.colliding(model).any())
        return cls(path, spec, plant, free, base, touches)

    @property
    def model(self) -> mujoco.MjModel:
        """The compiled MuJoCo model."""
        return self.plant.model

    def servos(self) -> Bool[Mask, " actuator"]:
        """Whether the control of each actuator is a target (position, velocity) and no force."""
        return self.model.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE

    def inertia(self) -> Float[Array, " nv"]:
        """Diagonal of the mass matrix at the nominal state, kg or kg m², with armature."""
        data = self._data()
        full = np.zeros((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, data, full)
        return np.diag(full).copy()

    def weight(self) -> Float[Array, " nv"]:
        """Scale g √(m M) of the force on each degree of freedom, N or N m.

        m is the mass that it moves and M its inertia: m g for a slide, m g ρ for a hinge with the
        radius of gyration ρ = √(M / m).
        """
        mass = self.model.body_subtreemass[self.model.dof_bodyid]
        g = float(np.linalg.norm(self.model.opt.gravity)) or EARTH
        return g * np.sqrt(mass * self.inertia())

    def strength(self) -> Float[Array, " nv"]:
        """Largest force of the actuators on each degree of freedom, N or N m; inf: no limit."""
        peak = self._peaks()
        moments = np.abs(self.moments())
        with np.errstate(invalid="ignore"):
            return np.where(moments > 0, moments * peak[:, None], 0.0).sum(axis=0)

    def moments(self) -> Float[Array, "actuator nv"]:
        """Moment arms of the actuators at the nominal state."""
        data = self._data()
        out = np.zeros((self.model.nactuator, self.model.nv))
        mujoco.mju_sparse2dense(
            out, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind
        )
        return out

    def settled(self) -> Float[Array, " nq"] | None:
        """The pose after the nominal control was held for a while; None if it is not finite."""
        engine, plant = backend.create(self.model), self.plant
        try:
            steps = max(1, round(SETTLING / float(self.model.opt.timestep)))
            end = engine.step(plant.x0[None], plant.u0[None], 0.0, steps)[0]
        finally:
            engine.close()
        return end[: self.model.nq] if np.isfinite(end).all() else None

    def _peaks(self) -> Float[Array, " actuator"]:
        """Largest force of each actuator before its gear; inf: the MJCF gives no limit."""
        model = self.model
        forced = model.actuator_forcelimited.astype(bool)
        by_force = np.where(forced, np.abs(model.actuator_forcerange).max(axis=1), np.inf)
        plain = (model.actuator_gaintype == mujoco.mjtGain.mjGAIN_FIXED) & ~self.servos()
        first = model.actuator_ctrladr
        limited = model.actuator_ctrllimited.astype(bool)[first]
        widest = np.abs(model.actuator_ctrlrange).max(axis=1)[first]
        by_control = np.abs(model.actuator_gainprm[:, 0]) * widest
        return np.minimum(by_force, np.where(plain & limited, by_control, np.inf))

    def _data(self) -> mujoco.MjData:
        data = mujoco.MjData(self.model)
        nq = self.model.nq
        data.qpos[:] = self.plant.x0[:nq]
        mujoco.mj_fwdPosition(self.model, data)
        return data


def _dofs_below(model: mujoco.MjModel, root: int) -> int:
    """Degrees of freedom of a body and of those attached to it."""
    inside = [root]
    for body in range(root + 1, model.nbody):  # a parent has a smaller number
        if model.body_parentid[body] in inside:
            inside.append(body)
    return int(model.body_dofnum[inside].sum())


def _last(model: mujoco.MjModel) -> int:
    """The body with the most degrees of freedom between it and the world; the first of them."""
    above = np.zeros(model.nbody, int)
    for body in range(1, model.nbody):
        above[body] = above[model.body_parentid[body]] + model.body_dofnum[body]
    return int(above.argmax())
