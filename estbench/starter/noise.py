"""Process noise of a first scenario: forces that the filter's model does not have."""

import numpy as np

from estbench.shapes import Array, Float
from estbench.starter.robot import Robot

SHARE = 0.02
"""Unmodelled force, as a share of what moves the robot."""
CORRELATION = 0.1
"""s; its correlation time."""


def density(robot: Robot) -> Float[Array, " nv"]:
    """Spectral density of the force on each degree of freedom, (N or N m)² s.

    q = 2 τ (s F)², white noise with the effect of a force of standard deviation s F and
    correlation time τ on motions slower than τ. F is the smaller of the strength of the actuators
    and of the weight that is moved; without an actuator it is the weight.
    """
    weight, strength = robot.weight(), robot.strength()
    force = np.where(strength > 0, np.minimum(strength, weight), weight)
    return 2.0 * CORRELATION * (SHARE * force) ** 2
