"""Absolute and relative errors of the pose of a moving base, as evo defines them; TUM files.

Sturm et al. 2012, "A benchmark for the evaluation of RGB-D SLAM systems" (IROS), sec. VI.
"""

import contextlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estbench.errors import LogError
from estbench.logs.frames import fitted
from estbench.shapes import Array, Float, Int, Ints
from estbench.spaces import rotation

SPAN = 1.0
"""s between the two poses of a relative error."""


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of a body.

    Attributes:
        times: s.
        position: m.
        turn: unit quaternions (w, x, y, z).
    """

    times: Float[Array, " k"]
    position: Float[Array, "k 3"]
    turn: Float[Array, "k 4"]


@dataclass(frozen=True)
class TrajectoryError:
    """Errors of a trajectory against a reference at the same times.

    Attributes:
        ate: root mean square distance after the estimate is fitted to the reference (evo's `ape`
            with `--align`), m.
        ate_turn: root mean square angle between the two, likewise, rad.
        rpe: root mean square of the translation of the relative error over `frames` (evo's `rpe`
            with `--all_pairs`), m.
        rpe_turn: the same of its angle, rad.
        frames: from the first pose of a pair to the second.
        poses: count.
    """

    ate: float
    ate_turn: float
    rpe: float
    rpe_turn: float
    frames: int
    poses: int


def errors(estimate: Poses, reference: Poses) -> TrajectoryError:
    """The errors of an estimate; ATE is NaN where all positions are on one line.

    ATE: the mean over i of |R p̂ᵢ + t - pᵢ|² with the R and t that minimize it. RPE: with the poses
    T̂ᵢ and Tᵢ, of (Tᵢ⁻¹ Tⱼ)⁻¹ (T̂ᵢ⁻¹ T̂ⱼ), j = i + frames, which no common transform changes.
    """
    away, turned = np.full_like(reference.position, np.nan), np.full(len(reference.times), np.nan)
    with contextlib.suppress(LogError):
        rigid = fitted(estimate.position, reference.position)
        away = rigid.points(estimate.position) - reference.position
        turned = _angle(rigid.rotations(estimate.turn), reference.turn)
    frames = int(np.clip(round(SPAN / np.median(np.diff(reference.times))), 1, len(away) - 1))
    i = np.arange(len(away) - frames)
    moved, turn = _relative(estimate, i, i + frames)
    truly, true_turn = _relative(reference, i, i + frames)
    # |R(a)^T (x - y)| = |x - y|: the rotation of the inverse changes no length.
    return TrajectoryError(
        _rms(away), float(np.sqrt(np.mean(turned**2))), _rms(moved - truly),
        float(np.sqrt(np.mean(_angle(turn, true_turn) ** 2))), frames, len(away),
    )  # fmt: skip


def _relative(poses: Poses, i: Int[Ints, " k"], j: Int[Ints, " k"]) -> tuple[Array, Array]:
    """Translation and rotation of Tᵢ⁻¹ Tⱼ."""
    R = rotation.matrix(poses.turn[i])
    step = poses.position[j] - poses.position[i]
    turn = rotation.multiply(rotation.conjugate(poses.turn[i]), poses.turn[j])
    return np.einsum("kji,kj->ki", R, step), turn


def _angle(p: Float[Array, "k 4"], q: Float[Array, "k 4"]) -> Float[Array, " k"]:
    return np.linalg.norm(rotation.log(rotation.multiply(rotation.conjugate(q), p)), axis=-1)


def _rms(vectors: Float[Array, "k 3"]) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=-1))))


def write_tum(path: Path, poses: Poses) -> None:
    """A trajectory as a TUM file: time, x, y, z, qx, qy, qz, qw, with all digits."""
    columns = np.column_stack([poses.times, poses.position, poses.turn[:, [1, 2, 3, 0]]])
    lines = (" ".join(repr(float(v)) for v in row) for row in columns)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
