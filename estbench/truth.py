"""Truth trajectories: the robot as it is, under its controller and its disturbance, and its sensors.

Arrays are time-major `(instant, run, ...)`: the event loop works on one instant of all runs.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from estbench import streams
from estbench.controllers import Controller
from estbench.manifold import Manifold
from estbench.models import mjcf
from estbench.models.disturbance import Disturbance
from estbench.models.mujoco import needed_stage
from estbench.models.rows import Rows
from estbench.scenario import Draw
from estbench.sensors import Channel, Instant

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Trajectory:
    """What happened in some runs.

    Attributes:
        x: true states `(instant + 1, run, nx)`, the first at t = 0; NaN from where MuJoCo failed.
        u: controls `(instant, run, nu)`, held up to the instant.
        y: what arrived at each instant `(run, ny)`, or None.
    """

    x: Array
    u: Array
    y: list[Array | None]


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
        self._rows = Rows(model)
        self._channels = {c.name: c for c in channels}
        mean, factor = initial
        self.x0 = space.plus(mean, streams.normals(seed, runs, "initial", 1, space.n)[0] @ factor.T)
        self._process = streams.normals(seed, runs, "process", len(instants), disturbance.rank)
        self._noise = {
            c.name: c.noise(seed, runs, sum(c.name in i.channels for i in instants))
            for c in channels
        }
        self._plans = {}
        self._taken = np.zeros(len(instants) + 1, dtype=object)
        counts = dict.fromkeys(self._channels, 0)
        for k, instant in enumerate(instants):
            self._taken[k] = dict(counts)
            for name in instant.channels:
                counts[name] += 1
        for key, draw in draws.items():
            self._draw(key, draw, seed, runs)

    def step(self, k: int, x: Array, u: Array) -> tuple[Array, Array | None]:
        """State at the end of instant k `(run, nx)` and the readings that arrive then.

        The sensors are read under the commanded control, without the disturbance: an accelerometer
        that saw the white force would correlate v with w, which every filter here excludes.
        """
        instant = self.instants[k]
        dt = instant.end - instant.start
        u = mjcf.clamp(self._model, u)
        noise, force, driven = self._disturbance, None, u
        if noise.rank:
            w = noise.sample(self._process[k], dt)
            if noise.kind == "force":
                force = w
            elif noise.kind == "actuator":
                driven = u + w
        x = self._rows.step(x, driven, instant.start, instant.nstep, force)
        if noise.rank and noise.kind == "additive":
            x = self._space.plus(x, w)
        return x, self._observe(k, instant, x, u)

    def clean(self, instant: Instant, x: Array, u: Array) -> Array:
        """Noise-free readings `(run, ny)` of the instant's channels."""
        if instant.channels not in self._plans:
            chosen = [self._channels[name] for name in instant.channels]
            columns = np.concatenate([c.columns for c in chosen])
            stage = needed_stage(self._model, [c.index for c in chosen])
            self._plans[instant.channels] = (columns, stage)
        columns, stage = self._plans[instant.channels]
        return self._rows.read(x, u, instant.end, stage, columns)

    def _observe(self, k: int, instant: Instant, x: Array, u: Array) -> Array | None:
        if not instant.channels:
            return None
        y = self.clean(instant, x, u)
        start = 0
        for name in instant.channels:
            space = self._channels[name].space
            part = slice(start, start + space.nx)
            y[:, part] = space.plus(y[:, part], self._noise[name][self._taken[k][name]])
            start = part.stop
        return y

    def _draw(self, key: str, draw: Draw, seed: int, runs: Sequence[int]) -> None:
        field, index = mjcf.parameter(self._model, key, "truth.draw")
        value = getattr(self._model, field)[index]
        z = streams.normals(seed, runs, f"parameter:{key}", 1, 1)[0]
        z = z.reshape(-1, *([1] * np.ndim(value)))
        self._rows.vary(len(runs), field, index, value * (1 + draw.relative_std * z) + draw.std * z)


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
    controls, readings = [], []
    u = np.empty(0)
    for k, instant in enumerate(instants):
        if instant.control:
            u = controller(
                round(instant.start / frame_time), instant.start, finite(x, simulator.x0)
            )
        x, y = simulator.step(k, x, u)
        states[k + 1] = x
        controls.append(u)
        readings.append(y)
    return Trajectory(states, np.stack(controls), readings)


def finite(x: Array, fallback: Array) -> Array:
    """X with the rows that are not finite replaced: a failed run must not reach a controller."""
    bad = ~np.isfinite(x).all(axis=-1)
    return np.where(bad[:, None], fallback, x) if bad.any() else x
