"""Rigid transforms between the frame of a truth and that of the model."""

from dataclasses import dataclass

import numpy as np

from estbench.errors import LogError
from estbench.shapes import Array, Float
from estbench.spaces import rotation


@dataclass(frozen=True, eq=False)
class Rigid:
    """x -> R x + t.

    Attributes:
        rotation: of R, a unit quaternion.
        translation: t, m.
    """

    rotation: Float[Array, " 4"]
    translation: Float[Array, " 3"]

    def points(self, p: Float[Array, "*any 3"]) -> Float[Array, "*any 3"]:
        """R p + t."""
        return self.vectors(p) + self.translation

    def vectors(self, v: Float[Array, "*any 3"]) -> Float[Array, "*any 3"]:
        """R v."""
        return v @ rotation.matrix(self.rotation).T

    def rotations(self, q: Float[Array, "*any 4"]) -> Float[Array, "*any 4"]:
        """The quaternion of R R(q)."""
        return rotation.multiply(self.rotation, q)


def fitted(points: Float[Array, "k 3"], onto: Float[Array, "k 3"]) -> Rigid:
    """The R and t that minimize Σ |y - R x - t|², without scale.

    Umeyama 1991, IEEE Trans. Pattern Anal. Mach. Intell. 13(4), eq. 38 to 43 with c = 1; the
    rotation is that of Horn 1987.

    Args:
        points: x.
        onto: y.

    Raises:
        LogError: fewer than three points, or all on one line.
    """
    if len(points) < 3:
        raise LogError(
            f"a frame can be fitted to 3 points or more, and the truth has {len(points)}; give "
            "log.truth.frame"
        )
    x, y = points - points.mean(axis=0), onto - onto.mean(axis=0)
    U, size, Vt = np.linalg.svd(y.T @ x / len(x))
    if size[1] <= 1e-12 * max(size[0], 1e-300):
        raise LogError(
            'a frame cannot be fitted to points on one line; give log.truth.frame = "given"'
        )
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    R = U @ sign @ Vt
    return Rigid(rotation.from_matrix(R), onto.mean(axis=0) - R @ points.mean(axis=0))
