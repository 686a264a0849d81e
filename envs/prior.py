"""x̂₀ and P₀ about the true state of an environment, along its equality constraints."""

import copy

import mujoco
import numpy as np

from estbench.robots import given
from estbench.robots.feasible import has_equalities
from estbench.robots.held import held
from estbench.shapes import Array, Float

_STATE = int(given.STATE | given.INPUTS)
_SMALL = 1e-9
"""Share of a constraint's largest singular value below which it repeats another one."""


class Prior:
    """Errors at the start: Π e with e ~ N(0, P₀), so that they are N(0, Π P₀ Πᵀ).

    Π = I - M⁻¹Jᵀ(J M⁻¹ Jᵀ)⁺J takes the changes of position, and of velocity, that leave the
    equality constraints alone; J is their Jacobian at the true state, with mocap bodies where they
    are, M the mass matrix. A state that breaks a weld to a mocap body, or a loop, is thrown back
    harder than a filter's quadrature describes. Without equality constraints Π = I.

    Args:
        model: of the environment.
        std: standard deviations of e, which is uncorrelated.
    """

    def __init__(self, model: mujoco.MjModel, std: Float[Array, " n"]):
        self._std, self._model = std, None
        if has_equalities(model) and std.any():
            self._model = out = copy.copy(model)
            flags = mujoco.mjtDisableBit
            out.opt.disableflags |= int(
                flags.mjDSBL_CONTACT | flags.mjDSBL_LIMIT | flags.mjDSBL_FRICTIONLOSS
            )
            out.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
            # With implicit damping d a coordinate resists as one of inertia M + h d.
            out.dof_armature[:] += np.where(held(model), model.dof_damping * model.opt.timestep, 0)

    def errors(
        self,
        x: Float[Array, "row nx"],
        inputs: Float[Array, "row inputs"],
        white: Float[Array, "row n"],
    ) -> tuple[Float[Array, "row n"], Float[Array, "row n n"]]:
        """Errors x₀ ⊖ x̂₀ from standard normals, and their covariance.

        Args:
            x: true states.
            inputs: all inputs of the robots, see `robots.given`.
            white: standard normals.
        """
        roots = np.repeat(np.diag(self._std)[None], len(x), axis=0)
        if self._model is not None:
            nv = self._model.nv
            for root, state, u in zip(roots, x, inputs):
                along = _along(self._model, state, u)
                for part in (slice(0, nv), slice(nv, 2 * nv)):
                    root[part, part] = along * self._std[part]
        return (roots @ white[..., None])[..., 0], roots @ roots.mT


def _along(model: mujoco.MjModel, x: Float[Array, " nx"], u: Float[Array, " _"]) -> Array:
    """Π at one state `(nv, nv)`."""
    data, nv = mujoco.MjData(model), model.nv
    mujoco.mj_setState(model, data, np.concatenate([[0.0], x, u]), _STATE)
    mujoco.mj_fwdPosition(model, data)
    M = np.empty((nv, nv))
    mujoco.mj_fullM(model, data, M)
    L = np.linalg.cholesky(M)
    white = np.linalg.solve(L, data.efc_J.reshape(-1, nv).T)  # L⁻¹ Jᵀ; L is lower triangular
    basis, size, _ = np.linalg.svd(white, full_matrices=False)
    basis = basis[:, size > _SMALL * size.max(initial=0.0)]
    return np.eye(nv) - np.linalg.solve(L.T, basis) @ (basis.T @ L.T)
