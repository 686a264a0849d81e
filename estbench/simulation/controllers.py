"""Controllers that excite the robot: u = controller(step, t, x), batched over runs.

A controller sees the true state or an estimate of it. A random one draws its numbers in advance
from the stream of each run, so the control of run i depends only on the seed and on what it sees.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import cast

import mujoco
import numpy as np

from estbench.errors import ControllerError, EstimatorError, user_error_location
from estbench.plugins import load_module
from estbench.randomness import streams
from estbench.robots import backend
from estbench.robots.controls import ControlRange
from estbench.robots.layout import control_names
from estbench.scenario.schema import ControlSection
from estbench.shapes import Array, Float
from estbench.simulation import control_file
from estbench.simulation.periodic import Periodic
from estbench.spaces.linalg import row_product
from estbench.spaces.manifold import Manifold
from estbench.spaces.patterns import expand

Controller = Callable[[int, float, Float[Array, "run nx"]], Float[Array, "run nu"]]
"""(filter step, time in s, state) -> control."""

BLOCK = 8192
"""Steps of a random control that are drawn at a time."""
CLOSED_LOOP = ("lqr", "user")
"""The kinds whose control may depend on the state that they see."""


@dataclass(frozen=True, eq=False)
class Plant:
    """The nominal robot, which a controller may use.

    Attributes:
        model: compiled MuJoCo model.
        space: its state space.
        x0: keyframe state.
        u0: keyframe control.
        nstep: physics steps between control updates.
    """

    model: mujoco.MjModel
    space: Manifold
    x0: Float[Array, " nx"]
    u0: Float[Array, " nu"]
    nstep: int

    @property
    def period(self) -> float:
        """Time between control updates, s."""
        return self.nstep * float(self.model.opt.timestep)


def build(
    section: ControlSection, plant: Plant, seed: int, runs: Sequence[int], steps: int
) -> Controller:
    """The controller of a scenario for some runs.

    Raises:
        ControllerError: it cannot be built (no stabilizing gain, an unreadable file, ...).
        DimensionError: a setting has the wrong count of values.
    """
    names = control_names(plant.model)
    shape = (len(runs), plant.model.nu)
    centre = plant.u0 if section.offset == "keyframe" else np.zeros(plant.model.nu)
    if section.kind == "none":
        return lambda k, t, x: np.broadcast_to(plant.u0, shape)
    if section.kind == "constant":
        if section.value is None:
            raise ControllerError("control.value is missing; constant needs the control to hold")
        value = expand(section.value, names, "control.value")
        return lambda k, t, x: np.broadcast_to(value, shape)
    if section.kind == "sine":
        return _sine(section, centre, names, shape)
    if section.kind == "random":
        std = expand(section.std, names, "control.std")
        correlation = float(np.exp(-plant.period / section.time_constant))
        smooth = _GaussMarkov(seed, runs, steps, plant.model.nu, correlation)
        return lambda k, t, x: centre + std * smooth(k)
    if section.kind == "lqr":
        gain = lqr_gain(plant, section)
        return lambda k, t, x: plant.u0 - row_product(plant.space.minus(x, plant.x0), gain)
    if section.kind == "periodic":
        gait = Periodic.build(section, names, centre)
        return lambda k, t, x: np.broadcast_to(gait(t), shape)
    if section.kind == "csv":
        times, table = control_file.read(section.path, names)
        return lambda k, t, x: np.broadcast_to(
            table[max(np.searchsorted(times, t + 1e-9, "right") - 1, 0)], shape
        )
    return _user(section.function)


def checked(controller: Controller, what: str, nu: int) -> Controller:
    """The controller; what it raises, and an unusable result, become a `ControllerError`."""

    def call(k: int, t: float, x: Array) -> Array:
        try:
            # A copy: a user's function may return the same array again, with other numbers in it.
            u = np.array(controller(k, t, x), dtype=np.float64)
        except (Exception, SystemExit) as error:  # a user's function may raise anything
            raise ControllerError(
                f"controller '{what}' raised at t = {t:g} s: {user_error_location(error)}"
            ) from None
        try:
            u = np.broadcast_to(u, (len(x), nu))
        except ValueError:
            raise ControllerError(
                f"controller '{what}' returned shape {u.shape}; expected {(len(x), nu)}"
            ) from None
        if not np.isfinite(u).all():
            run = int(np.flatnonzero(~np.isfinite(u).all(axis=1))[0])
            raise ControllerError(
                f"controller '{what}' returned a value that is not finite at t = {t:g} s "
                f"(row {run} of {len(x)}); return finite controls"
            )
        return u

    return call


def clamped(section: ControlSection, plant: Plant) -> list[str]:
    """A notice for each actuator whose control exceeds its ctrlrange."""
    names, model = control_names(plant.model), plant.model
    centre = plant.u0 if section.offset == "keyframe" else np.zeros(model.nu)
    if section.kind == "constant" and section.value is not None:
        least = most = expand(section.value, names, "control.value")
    elif section.kind == "sine":
        peak = np.abs(expand(section.amplitude, names, "control.amplitude"))
        peak = peak * len(section.frequencies)
        least, most = centre - peak, centre + peak
    elif section.kind == "periodic":
        least, most = Periodic.build(section, names, centre).bounds()
    elif section.kind == "csv":
        _, table = control_file.read(section.path, names)
        least, most = table.min(axis=0), table.max(axis=0)
    else:
        return []
    limits = ControlRange.of(model)
    low, high = limits.low, limits.high
    slack = 1e-9 * (np.abs(least) + np.abs(most))  # 0.1 + 0.2 is no more than 0.3
    beyond = np.where(most - slack > high, most, np.where(least + slack < low, least, np.nan))
    return [
        f"control goes to {beyond[i]:g} on {names[i]}, whose ctrlrange is [{low[i]:g}, "
        f"{high[i]:g}]: it is clamped"
        for i in np.flatnonzero(~np.isnan(beyond))
    ]


def linearize(plant: Plant) -> tuple[Float[Array, "n n"], Float[Array, "n nu"]]:
    """A and B of one control period about the keyframe, centred differences."""
    engine, space, step = backend.create(plant.model), plant.space, 1e-6
    n, nu = space.n, plant.model.nu
    x = np.broadcast_to(plant.x0, (1, 2 * (n + nu) + 1, plant.x0.size)).copy()
    u = np.broadcast_to(plant.u0, (1, 2 * (n + nu) + 1, nu)).copy()
    x[0, 1 : n + 1] = space.plus(plant.x0, step * np.eye(n))
    x[0, n + 1 : 2 * n + 1] = space.plus(plant.x0, -step * np.eye(n))
    u[0, 2 * n + 1 : 2 * n + nu + 1] += step * np.eye(nu)
    u[0, 2 * n + nu + 1 :] -= step * np.eye(nu)
    ends = engine.step(x, u, 0.0, plant.nstep)[0]
    change = space.minus(ends, ends[0]) / (2 * step)
    A = (change[1 : n + 1] - change[n + 1 : 2 * n + 1]).T
    B = (change[2 * n + 1 : 2 * n + nu + 1] - change[2 * n + nu + 1 :]).T
    return A, B


def lqr_gain(plant: Plant, section: ControlSection) -> Float[Array, "nu n"]:
    """K with u = u₀ - K (x ⊖ x₀), from the discrete algebraic Riccati equation.

    Raises:
        ControllerError: the keyframe cannot be stabilized.
    """
    from scipy.linalg import solve_discrete_are  # a sixth of the start of `estbench list`

    A, B = linearize(plant)
    Q = np.diag(expand(section.state_weight, plant.space.names, "control.state_weight"))
    names = control_names(plant.model)
    R = np.diag(expand(section.control_weight, names, "control.control_weight", 1.0))
    try:
        X = solve_discrete_are(A, B, Q, R)
        return np.linalg.solve(R + B.T @ X @ B, B.T @ X @ A)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ControllerError(
            f"lqr: no stabilizing gain about the keyframe ({error}); check that the actuators can "
            "move every unstable coordinate, that control_weight > 0, or choose another controller"
        ) from None


def _sine(
    section: ControlSection, centre: Array, names: Sequence[str], shape: tuple[int, int]
) -> Controller:
    amplitude = expand(section.amplitude, names, "control.amplitude")
    frequencies = np.asarray(section.frequencies)
    # Actuators are driven out of phase, else they would excite one direction only.
    phase = 2 * np.pi * np.arange(len(names)) / max(len(names), 1)

    def sine(k: int, t: float, x: Array) -> Array:
        terms = np.sin(2 * np.pi * frequencies[:, None] * t + phase).sum(axis=0)
        return np.broadcast_to(centre + amplitude * terms, shape)

    return sine


class _GaussMarkov:
    """Unit-variance first-order Gauss-Markov sequences, `BLOCK` steps at a time.

    Args:
        seed: of the streams.
        runs: their numbers.
        steps: how many there are.
        width: numbers per step.
        correlation: from one step to the next.
    """

    def __init__(self, seed: int, runs: Sequence[int], steps: int, width: int, correlation: float):
        self._asked = seed, runs, steps, width
        self._correlation = correlation
        self._begin()

    def __call__(self, k: int) -> Float[Array, "run nu"]:
        """The k-th step; a step before the last block begins anew."""
        if k < self._stop - len(self._block):
            self._begin()
        while k >= self._stop:
            self._fill()
        return self._block[k - self._stop]

    def _begin(self) -> None:
        seed, runs, _, width = self._asked
        self._streams = list(streams.streams(seed, runs, "control")) if width else []
        self._stop, self._block = 0, np.zeros((0, len(runs), width))

    def _fill(self) -> None:
        """The next block, from standard normals."""
        _, runs, steps, width = self._asked
        before, count = self._block[-1:], min(BLOCK, steps - self._stop)
        white = np.empty((count, len(runs), width))
        for row, own in enumerate(self._streams):
            white[:, row] = own.standard_normal((count, width))
        out = white * np.sqrt(1.0 - self._correlation**2)
        if not self._stop:
            out[:1] = white[:1]
        else:
            out[0] += self._correlation * before[0]
        for k in range(1, len(out)):
            out[k] += self._correlation * out[k - 1]
        self._block, self._stop = out, self._stop + count


def _user(target: str | None) -> Controller:
    module, colon, name = (target or "").partition(":")
    if not colon:
        raise ControllerError(f"control.function is {target!r}; use 'module:function'")
    try:
        function = getattr(load_module(module, "control.function"), name, None)
    except EstimatorError as error:
        raise ControllerError(str(error)) from None
    if not callable(function):
        raise ControllerError(f"control.function: module {module} has no function '{name}'")
    user = cast(Callable[[float, Array], Array], function)
    return lambda k, t, x: user(t, x.copy())  # it may compute in place
