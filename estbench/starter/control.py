"""The controller of a first scenario: one that moves the robot, or holds it where it would fall."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from estbench.errors import ControllerError
from estbench.robots.controls import ControlRange
from estbench.robots.layout import control_names
from estbench.scenario.schema import ControlSection
from estbench.simulation import controllers
from estbench.starter.robot import Robot

SHARE = 0.1
"""Of the range of a control that the controller uses."""
TURN = 0.1
"""rad or m; amplitude of a target that has no range."""
_UNSTABLE = 1.0 + 1e-4
"""Modulus of an eigenvalue, per control period, from which a robot falls."""


@dataclass(frozen=True)
class Choice:
    """A controller.

    Attributes:
        kind: as `control.kind`.
        why: one line for the file.
        sizes: control -> amplitude (sine) or standard deviation (random).
    """

    kind: str
    why: str
    sizes: Mapping[str, float]


def choose(robot: Robot) -> Choice:
    """LQR where the robot stands still and would fall; else targets that swing, random forces."""
    if not robot.model.nu:
        return Choice("none", "the robot has no actuator", {})
    if robot.servos().any():
        why = "targets that swing about those of the keyframe, each actuator out of phase"
        return Choice("sine", why, _sizes(robot))
    if not (robot.free and robot.touches) and _balances(robot):
        return Choice("lqr", "holds the nominal state, which is unstable", {})
    return Choice("random", "random forces about those of the keyframe", _sizes(robot))


def _balances(robot: Robot) -> bool:
    """Whether the nominal state is an unstable equilibrium that LQR can hold."""
    from estbench.robots import backend

    plant = robot.plant
    engine = backend.create(robot.model)
    try:
        end = engine.step(plant.x0[None], plant.u0[None], 0.0, plant.nstep)
    finally:
        engine.close()
    moved = plant.space.minus(end, plant.x0[None])
    if not np.isfinite(end).all() or np.abs(moved).max() > 1e-6:
        return False
    try:
        A, _ = controllers.linearize(plant)
        controllers.lqr_gain(plant, ControlSection(kind="lqr"))
    except (ControllerError, np.linalg.LinAlgError):
        return False
    return bool(np.abs(np.linalg.eigvals(A)).max() > _UNSTABLE)


def _sizes(robot: Robot) -> dict[str, float]:
    """Each control by a share of its range; a force without one by a share of the weight."""
    model = robot.model
    limits = ControlRange.of(model)
    half = (limits.high - limits.low) / 2.0
    moments, weight, servos = np.abs(robot.moments()), robot.weight(), robot.servos()
    gain = np.abs(model.actuator_gainprm[:, 0])
    sizes = {}
    owners = np.repeat(np.arange(model.nactuator), model.actuator_ctrlnum)
    for k, (name, actuator) in enumerate(zip(control_names(model), owners)):
        size = SHARE * half[k]
        if not np.isfinite(size):
            moved = moments[actuator] > 1e-9
            force = gain[actuator] * moments[actuator][moved]
            plain = not servos[actuator] and force.size and force.all()
            size = SHARE * (weight[moved] / force).min() if plain else TURN
        sizes[name] = float(f"{size:.2g}")
    return sizes
