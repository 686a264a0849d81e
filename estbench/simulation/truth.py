"""Truth trajectories: the robot as it is, its controller, its disturbance and its sensors.

Arrays are time-major `(instant, run, ...)`: the event loop works on one instant of all runs.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from estbench.randomness import streams
from estbench.robots import backend, parameters
from estbench.robots.controls import ControlRange
from estbench.robots.disturbance import Disturbance
from estbench.robots.measurement import Plan
from estbench.scenario.schema import Draw
from estbench.sensors.channel import Channel
from estbench.sensors.sampling import Delivery, Readings
from estbench.sensors.timing import Instant
from estbench.shapes import Array
from estbench.simulation.controllers import Controller
from estbench.spaces.manifold import Manifold


@dataclass(frozen=True, eq=False)
class Trajectory:
    """What happened in some runs.

    Attributes:
        x: true states `(instant + 1, run, nx)`, the first at t = 0; NaN from where MuJoCo failed.
        u: controls `(instant, run, nu)`, held up to the instant.
        deliveries: what arrived at each instant.
    """

    x: Array
    u: Array
    deliveries: list[list[Delivery]]


class Simulator:
    """The true robot for some runs: one step of all of them under a given control.

    Every random number is drawn beforehand from the runs' own streams, so a run is the same
    whichever estimator watches it and whichever runs share its batch.

    Args:
        model: compiled truth model.
        space: its state space.
        channels: sensors in use.
        instants: the event loop's schedule.
        disturbance: the true process noise.
        initial: mean `(nx,)` and Cholesky factor of P₀ `(n, n)`.
        draws: model parameters drawn once a run.
        seed: of the scenario.
        runs: numbers of the runs.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        space: Manifold,
        channels: Sequence[Channel],
        instants: Sequence[Instant],
        disturbance: Disturbance,
        initial: tuple[Array, Array],
        draws: Mapping[str, Draw],
        seed: int,
        runs: Sequence[int],
    ):
        self.instants = instants
        self._model, self._space, self._disturbance = model, space, disturbance
        self._backend, self._range = backend.create(model), ControlRange.of(model)
        self._channels = {c.name: c for c in channels}
        mean, factor = initial
        self.x0 = space.plus(mean, streams.normals(seed, runs, "initial", 1, space.n)[0] @ factor.T)
        self._process = streams.normals(seed, runs, "process", len(instants), disturbance.rank)
        self._readings = [Readings(c, instants, seed, runs) for c in channels]
        self._plans: dict[tuple[str, ...], Plan] = {}
        for key, draw in draws.items():
            self._draw(key, draw, seed, runs)

    def step(self, k: int, x: Array, u: Array) -> tuple[Array, list[Delivery]]:
        """State at the end of instant k `(run, nx)` and the readings that arrive then.

        The sensors are read under the commanded control, without the disturbance: an accelerometer
        that saw the white force would correlate v with w, which every filter here excludes.
        """
        instant = self.instants[k]
        dt = instant.end - instant.start
        u = self._range.clamp(u)
        noise, force, driven = self._disturbance, None, u
        if noise.rank:
            w = noise.sample(self._process[k], instant.start, dt)
            if noise.kind == "force":
                force = w
            elif noise.kind == "actuator":
                driven = u + w
        x = self._backend.step(x, driven, instant.start, instant.nstep, force)
        if noise.rank and noise.kind == "additive":
            x = self._space.plus(x, w)
        return x, self._observe(k, instant.end, x, u)

    def clean(self, channels: Sequence[Channel], t: float, x: Array, u: Array) -> Array:
        """Noise-free readings `(run, ny)` of some channels, one after the other."""
        key = tuple(c.name for c in channels)
        if key not in self._plans:
            self._plans[key] = Plan(self._model, [c.source for c in channels])
        return self._plans[key].read(self._backend, x, u, t)

    def _observe(self, k: int, t: float, x: Array, u: Array) -> list[Delivery]:
        """Take the readings that are due, and hand out those that arrive."""
        taking = [r.channel for r in self._readings if r.takes(k)]
        y = self.clean(taking, t, x, u) if taking else np.empty((len(x), 0))
        out: list[Delivery] = []
        start = 0
        for readings in self._readings:
            part = None
            if readings.takes(k):
                part = y[:, start : start + readings.channel.space.nx]
                start += readings.channel.space.nx
            out += readings.at(k, part)
        return out

    def _draw(self, key: str, draw: Draw, seed: int, runs: Sequence[int]) -> None:
        field, index = parameters.parameter(self._model, key, "truth.draw")
        value = getattr(self._model, field)[index]
        z = streams.normals(seed, runs, f"parameter:{key}", 1, 1)[0]
        self._backend.vary(
            len(runs), field, index, parameters.drawn(value, draw.relative_std, draw.std, z)
        )


def simulate(simulator: Simulator, controller: Controller, frame_time: float) -> Trajectory:
    """Run the robot through its schedule under a controller that sees the true state.

    Args:
        simulator: the true robot.
        controller: asked at every instant that says so.
        frame_time: time between control updates, s.
    """
    instants, x = simulator.instants, simulator.x0
    states = np.empty((len(instants) + 1, *x.shape))
    states[0] = x
    controls, deliveries = [], []
    u = np.empty(0)
    for k, instant in enumerate(instants):
        if instant.control:
            u = controller(
                round(instant.start / frame_time), instant.start, finite(x, simulator.x0)
            )
        x, arrived = simulator.step(k, x, u)
        states[k + 1] = x
        controls.append(u)
        deliveries.append(arrived)
    return Trajectory(states, np.stack(controls), deliveries)


def finite(x: Array, fallback: Array) -> Array:
    """X with the rows that are not finite replaced: a failed run must not reach a controller."""
    bad = ~np.isfinite(x).all(axis=-1)
    return np.where(bad[:, None], fallback, x) if bad.any() else x
