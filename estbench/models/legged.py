"""A legged robot as filters of IMU and leg kinematics see it: sensors, joints and feet."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from estbench.models.protocol import Model
from estbench.shapes import Array, Bool, Float, Int, Mask

FootKinematics = Callable[
    [Float[Array, "run joint"]],
    tuple[
        Float[Array, "run foot 3"],
        Float[Array, "run foot 3 joint"],
        Float[Array, "run foot 3 joint"],
    ],
]
"""Joint angles -> s, the feet in the frame of the IMU, m; their Jacobians ∂s/∂q, and those of their
orientation, T: a foot turns against the IMU by T dq."""


@dataclass(frozen=True, eq=False)
class Legs:
    """Sensors, joints and feet of a robot with a floating base.

    The frame of the IMU is fixed in the base: p_IMU = p + R r and R_IMU = R C.

    Attributes:
        gyro: channel of the angular velocity of the IMU, in its axes.
        accelerometer: channel of the specific force, in the same axes.
        encoders: channel of each joint's encoder.
        touches: channel of each foot's touch sensor, N.
        root: index of the base's position in x and in its tangent; a unit quaternion, then the
            joints, follow the three numbers of the position.
        velocity: index of the base's linear velocity in x and in its tangent; it is in the world's
            axes, and the angular velocity that follows in those of the base.
        joints: index of each joint in x and in its tangent `(joint, 2)`.
        rates: index of each joint's velocity in x and in its tangent `(joint, 2)`.
        offset: r, m.
        axes: C.
        gravity: in the world's axes, m/s².
        weight: N.
        moves: whether a joint moves a foot.
        order: all channels of the model, in the order of a whole measurement.
        feet: the kinematics.
        radii: of spherical feet, which roll, with the foot's point at the centre, m; else 0.
    """

    gyro: str
    accelerometer: str
    encoders: tuple[str, ...]
    touches: tuple[str, ...]
    root: tuple[int, int]
    velocity: tuple[int, int]
    joints: Int[NDArray[np.intp], "joint 2"]
    rates: Int[NDArray[np.intp], "joint 2"]
    offset: Float[Array, " 3"]
    axes: Float[Array, "3 3"]
    gravity: Float[Array, " 3"]
    weight: float
    moves: Bool[Mask, "foot joint"]
    order: tuple[str, ...]
    feet: FootKinematics
    radii: Float[Array, " foot"]


@runtime_checkable
class LeggedModel(Model, Protocol):
    """A model that knows its legs."""

    @property
    def legs(self) -> Legs:
        """The legs of the robot.

        Raises:
            ScenarioError: it has none, or lacks a sensor.
        """
        ...
