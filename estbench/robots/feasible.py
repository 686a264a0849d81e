"""The nearest state on the equality constraints, and out of deep contacts.

MuJoCo's constraints are soft: a state that breaks a weld, a loop or a coupling by some millimetres
is thrown back onto it within its time constant, often harder than a filter's quadrature survives.

A Gauss-Newton step in the metric of the mass matrix M takes positions with the violations r and the
Jacobian J to the constraints:

    q⁺ = q ⊞ -M⁻¹ Jᵀ (J M⁻¹ Jᵀ)⁻¹ r,

and the velocities that leave the constraints alone are v - M⁻¹ Jᵀ (J M⁻¹ Jᵀ)⁻¹ J v. Both are one
step of MuJoCo's own solver on a copy of the model without forces, whose constraints have no time
constant. So every type of constraint counts (connect, weld, joint, tendon, flex, contact), and
redundant ones are met in the sense of least squares.
"""

import copy

import mujoco
import numpy as np

from estbench.robots import backend
from estbench.shapes import Array, Bool, Float, Mask
from estbench.spaces.manifold import Manifold

_HARD = float(mujoco.mjMAXIMP)
"""The largest impedance that MuJoCo takes: a step leaves 1 - _HARD of a violation."""
DEEP = 0.01
"""Penetration that is deep, m: what is less deep is left to the physics."""
_ITERATIONS = 25
_MOVED = 1e-9
"""Change of a coordinate in one step, in its unit, up to which the steps have converged."""
_FAR = 1.0
"""Change of a coordinate, in its unit, beyond which contacts are left as they are."""


def has_equalities(model: mujoco.MjModel) -> bool:
    """Whether an equality constraint is active."""
    off = model.opt.disableflags & int(
        mujoco.mjtDisableBit.mjDSBL_EQUALITY | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    )
    return not off and bool(np.any(model.eq_active0))


class Feasible:
    """Projects states of a robot.

    Args:
        model: compiled MuJoCo model.
        space: its state space.
        contacts: whether penetrations deeper than `DEEP` are resolved too.
    """

    def __init__(self, model: mujoco.MjModel, space: Manifold, contacts: bool):
        self._space, self._nq, self._nv, self._nu = space, model.nq, model.nv, model.nu
        self._all = self._equalities = self._velocities = None
        if contacts:
            self._all = backend.create(_without_forces(model, True, stiff=True))
        if has_equalities(model):
            self._equalities = backend.create(_without_forces(model, False, stiff=True))
            self._velocities = backend.create(_without_forces(model, False, stiff=False))

    def project(self, x: Float[Array, "row nx"]) -> Float[Array, "row nx"]:
        """The states with positions on the constraints and velocities along the equalities.

        Each row is a function of its own state alone. Where contacts and equalities contradict each
        other (geoms of a robot that overlap in its own rest pose), or would be resolved far away
        only, contacts are left as they are. A row that MuJoCo cannot compute stays as it is.
        """
        out = x.copy()
        left = np.ones(len(x), bool)
        for engine in (self._all, self._equalities):
            if engine is not None and left.any():
                settled, converged = self._settled(engine, x[left])
                last = engine is self._equalities
                out[left] = np.where((converged | last)[:, None], settled, x[left])
                left[left] = ~converged
        return out if self._velocities is None else self._along(out)

    def close(self) -> None:
        """Release the backends."""
        for engine in (self._all, self._equalities, self._velocities):
            if engine is not None:
                engine.close()

    def resolves_contacts(self, x: Float[Array, "row nx"]) -> Bool[Mask, " row"]:
        """Whether all constraints can be met near these states, the contacts among them."""
        if self._all is None:
            return np.zeros(len(x), bool)
        return self._settled(self._all, x)[1]

    def _settled(self, engine: backend.Backend, x: Array) -> tuple[Array, Mask]:
        """The states with positions on the constraints of a model, and which have converged."""
        out, left, converged = x.copy(), np.arange(len(x)), np.zeros(len(x), bool)
        for _ in range(_ITERATIONS):
            at = out[left].copy()
            at[:, self._nq : self._nq + self._nv] = 0.0
            there = self._step(engine, at)
            moved = self._distance(there, at)
            valid = np.isfinite(moved)
            out[left[valid], : self._nq] = there[valid, : self._nq]
            converged[left] = valid & (moved <= _MOVED)
            left = left[valid & (moved > _MOVED)]
            if not len(left):
                break
        return out, converged & (self._distance(out, x) <= _FAR)

    def _distance(self, a: Array, b: Array) -> Float[Array, " row"]:
        """The largest difference of a position coordinate."""
        return np.abs(self._space.minus(a, b)[:, : self._nv]).max(axis=1, initial=0.0)

    def _along(self, x: Array) -> Array:
        """The states with the velocities that keep the equality constraints.

        The odd part of a step's answer to ±v: the even part is that of inertial forces and of the
        remaining violations.
        """
        assert self._velocities is not None
        speeds, left = slice(self._nq, self._nq + self._nv), np.arange(len(x))
        for _ in range(_ITERATIONS):  # each leaves some of a forbidden velocity
            ahead, back = x[left], x[left].copy()
            back[:, speeds] *= -1.0
            answers = [self._step(self._velocities, state)[:, speeds] for state in (ahead, back)]
            v = (answers[0] - answers[1]) / 2
            changed = np.abs(v - ahead[:, speeds]).max(axis=1)
            valid = np.isfinite(changed)
            x[left[valid], speeds] = v[valid]
            left = left[valid & (changed > _MOVED)]
            if not len(left):
                break
        return x

    def _step(self, engine: backend.Backend, x: Array) -> Array:
        return engine.step(x, np.zeros((len(x), self._nu)), 0.0, 1)


def _without_forces(model: mujoco.MjModel, contacts: bool, stiff: bool) -> mujoco.MjModel:
    """A copy of which a step of 1 s answers to violations (stiff), or to forbidden velocities."""
    out, flags = copy.copy(model), mujoco.mjtDisableBit
    option = out.opt
    option.timestep, option.integrator = 1.0, mujoco.mjtIntegrator.mjINT_EULER
    option.solver, option.iterations, option.tolerance = mujoco.mjtSolver.mjSOL_NEWTON, 200, 1e-14
    option.noslip_iterations, option.density, option.viscosity = 0, 0.0, 0.0
    option.disableflags |= int(
        flags.mjDSBL_GRAVITY | flags.mjDSBL_ACTUATION | flags.mjDSBL_SPRING | flags.mjDSBL_DAMPER
        | flags.mjDSBL_FRICTIONLOSS | flags.mjDSBL_SENSOR
    )  # fmt: skip
    option.disableflags |= int(flags.mjDSBL_LIMIT)
    if not contacts:
        option.disableflags |= int(flags.mjDSBL_CONTACT)
    out.geom_condim[:] = out.pair_dim[:] = 1
    out.geom_margin[:], out.pair_margin[:] = -DEEP / 2, -DEEP  # those of two geoms add up
    out.geom_gap[:] = out.pair_gap[:] = 0.0
    # In the direct format a constraint wants J v̇ = -(damping J v + stiffness r) / impedance.
    reference = (-(_HARD**2), 0.0) if stiff else (0.0, -_HARD)
    for kind in ("eq_{}", "geom_{}", "pair_{}"):
        getattr(out, kind.format("solref"))[:] = reference
        getattr(out, kind.format("solimp"))[:] = (_HARD, _HARD, 1e-3, 0.5, 2.0)
    return out
