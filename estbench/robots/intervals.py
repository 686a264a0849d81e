"""The physics steps in an interval of time."""

import math

from estbench.errors import ScenarioError


def equal_steps(dt: float, timestep: float) -> tuple[int, float | None]:
    """The number and the length of the physics steps in any dt > 0.

    The least number of equal steps that are at most as long as the timestep. The length is None
    where it is the timestep itself, but for rounding.
    """
    ratio = dt / timestep
    near = round(ratio)
    if near >= 1 and abs(ratio - near) <= 1e-6 * ratio:
        return near, None
    steps = math.ceil(ratio)
    return steps, dt / steps


def whole_steps(dt: float, timestep: float, what: str) -> int:
    """The number of physics steps in dt.

    Raises:
        ScenarioError: dt is not a positive multiple of the timestep.
    """
    ratio = dt / timestep
    steps = round(ratio)
    if steps < 1 or abs(ratio - steps) > 1e-6 * max(1.0, ratio):
        raise ScenarioError(
            f"{what} = {dt:g} s is not a multiple of the timestep {timestep:g} s "
            f"(nearest: {max(steps, 1) * timestep:g} s)"
        )
    return steps
