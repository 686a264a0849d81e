"""Simulated runs under the controls, at the times and with the gaps of a recorded log.

The robot of the simulation is what an estimator believes: its model, Q and R, fitted to the log or
not. The controls are those of the log, so the robot moves in open loop, and its motion may leave
that of the log.
"""

from collections.abc import Sequence

import numpy as np

from estbench.errors import CovarianceError
from estbench.experiment.prepared import Setup
from estbench.logs import clock
from estbench.logs.readings import ChannelReadings
from estbench.logs.source import Log
from estbench.randomness import streams
from estbench.robots import backend
from estbench.robots.controls import ControlRange
from estbench.robots.intervals import equal_steps
from estbench.sensors.delivery import Delivery
from estbench.shapes import Array, Float, Int, Ints
from estbench.simulation.sources import Trajectory
from estbench.spaces.semidefinite import psd_root


def simulated(prepared: Setup, label: str, log: Log, runs: Sequence[int]) -> Trajectory:
    """Runs of the robot as an estimator believes it to be.

        x₀ ~ N(x̂₀, P₀), x⁺ = f(x, u, w), y = round((h(x, u) ⊞ v)/step) step

    with w and v of the filter's Q and R. A channel with `quantization` has its step, whose variance
    step²/12 is a part of R: v has the rest.

    Args:
        prepared: the experiment, at the instants of the log.
        label: of the estimator.
        log: gives controls, times and missing components.
        runs: their numbers.

    Raises:
        CovarianceError: R of a quantized channel is less than step²/12.
    """
    side, seed = prepared.believed[label], prepared.scenario.simulation.seed
    physics, limits = backend.create(side.robot), ControlRange.of(side.robot)
    noise, instants, space = side.disturbance, log.instants, prepared.space
    mean, cov = prepared.prior(label)
    first = streams.normals(seed, runs, "initial", 1, space.n)[0]
    white = streams.normals(seed, runs, "process", len(instants), noise.rank)
    x = space.plus(np.repeat(mean[None], len(runs), axis=0), first @ psd_root(cov).T)
    states = [x]
    for k, instant in enumerate(instants):
        t, dt = instant.start, instant.end - instant.start
        if dt:
            u = limits.clamp(np.repeat(log.u[k : k + 1], len(runs), axis=0))
            w = noise.sample(white[k], t, dt)
            count, step = equal_steps(dt, float(side.robot.opt.timestep))
            force = w if noise.kind == "force" and noise.rank else None
            driven = u + w if noise.kind == "actuator" else u
            x = physics.step(x, driven, t, count, force, step)
            x = space.plus(x, w) if noise.kind == "additive" else x
        states.append(x)
    physics.close()
    found = np.stack(states)
    deliveries: list[list[Delivery]] = [[] for _ in instants]
    ticks = np.array([instant.tick for instant in instants])
    for part in log.channels:
        taken = clock.ticks(part.taken - log.start)
        place = np.searchsorted(ticks, clock.ticks(part.arrived - log.start))
        y = _readings(prepared, label, log, part, found, np.searchsorted(ticks, taken), runs)
        for k, when, values in zip(place.tolist(), taken.tolist(), y):
            deliveries[k].append(Delivery((part.name,), when, values, None, when))
    u = np.repeat(log.u[:, None], len(runs), axis=1)
    return Trajectory(found, u, deliveries)


def _readings(
    prepared: Setup,
    label: str,
    log: Log,
    part: ChannelReadings,
    x: Float[Array, "time run nx"],
    place: Int[Ints, " k"],
    runs: Sequence[int],
) -> Float[Array, "k run ny"]:
    """The readings of a channel at its instants `place`."""
    name, side = part.name, prepared.believed[label]
    model, space = prepared.model(believed=side), prepared.channel_spaces[name]
    true = next(c for c in prepared.channels if c.name == name)
    step = np.zeros(space.n) if true.imperfections is None else true.imperfections.quantization
    cov = model.measurement_noise(0.0, (name,)) - np.diag(step**2 / 12.0)
    if np.diag(cov).min() < 0:
        raise CovarianceError(
            f"filter.channels.{name}.noise is less than a step of {step.max():g} over √12, which "
            f"is what quantization alone has; raise it, or lower channels.{name}.quantization"
        )
    white = streams.normals(
        prepared.scenario.simulation.seed, runs, f"sensor:{name}", len(place), space.n
    )
    rows = []
    for k, at in enumerate(place.tolist()):
        u = np.repeat(log.u[at : at + 1], len(runs), axis=0)
        y = model.measurement(x[at + 1], u, log.instants[at].end, (name,))
        rows.append(space.plus(y, white[k] @ psd_root(cov).T))
    y = np.stack(rows)
    if step.any():  # a quantized channel is flat
        grid = np.where(step > 0, step, 1.0)
        y = np.where(step > 0, grid * np.round(y / grid), y)
    return np.where(np.isfinite(part.y)[:, None], y, part.y[:, None])
