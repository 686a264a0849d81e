"""Symmetries of a robot with a floating base on level ground: its place and its heading."""

from dataclasses import dataclass

import mujoco
import numpy as np

from estbench.errors import ScenarioError
from estbench.robots import layout
from estbench.shapes import Array, Float
from estbench.spaces import rotation


@dataclass(frozen=True, eq=False)
class LevelGround:
    """Two horizontal moves and the turn about the vertical e, at the place where the robot is.

    The robot moves alike wherever it is and whatever way it looks if the ground is level and alike
    everywhere. The tangents are (δp, φ, δv) = (h₁, 0, 0), (h₂, 0, 0) and (0, Rᵀ e, e × v), with
    h₁, h₂ ⊥ e: φ in the axes of the base, v in those of the world. Steps, slopes and other bodies
    in the world break the symmetry; they are not looked for.

    Attributes:
        root: index of the base's position in x and in its tangent.
        velocity: of its linear velocity.
        n: dimension of the tangent.
        up: e.
    """

    root: tuple[int, int]
    velocity: tuple[int, int]
    n: int
    up: Float[Array, " 3"]
    count: int = 3

    def __call__(self, x: Float[Array, "run nx"]) -> Float[Array, "run n k"]:
        """The tangents at x, as columns."""
        (p, dp), (v, dv) = self.root, self.velocity
        out = np.zeros((len(x), self.n, self.count))
        out[:, dp : dp + 3, :2] = np.linalg.qr(self.up[:, None], mode="complete")[0][:, 1:]
        out[:, dp + 3 : dp + 6, 2] = self.up @ rotation.matrix(x[:, p + 3 : p + 7])
        out[:, dv : dv + 3, 2] = np.cross(self.up, x[:, v : v + 3])
        return out


def find(model: mujoco.MjModel) -> LevelGround:
    """The symmetries of a robot.

    Raises:
        ScenarioError: there is no gravity, or more moves than one body with a free joint and what
            hangs on it.
    """
    free = np.flatnonzero(model.jnt_type == layout.FREE)
    size = np.linalg.norm(model.opt.gravity)
    if size == 0.0 or len(free) != 1 or model.ntree != 1:
        raise ScenarioError(
            "place and heading are symmetries of one robot with a free joint under gravity only"
        )
    qpos, dof = int(model.jnt_qposadr[free[0]]), int(model.jnt_dofadr[free[0]])
    velocity = model.nq + dof, model.nv + dof
    return LevelGround((qpos, dof), velocity, 2 * model.nv + model.na, -model.opt.gravity / size)
