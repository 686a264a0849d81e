"""A true system along its motion: F, Γ and what each channel reads of the state, step by step."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from estbench.bounds.expectation import Reading, whitened
from estbench.bounds.linearization import Linearized
from estbench.bounds.scenario import readings, true_system
from estbench.bounds.sensor_errors import errors
from estbench.errors import ScenarioError
from estbench.experiment import recording
from estbench.experiment.prepared import Setup
from estbench.shapes import Array, Float, Mask
from estbench.spaces.linalg import is_positive_definite, quiet


@dataclass(frozen=True, eq=False)
class Step:
    """One interval, and what is read at its end.

    Attributes:
        F: of the transition.
        G: response of the state to a unit of each white noise; one, or one per run.
        seen: channel -> R^(-1/2) H, and the runs in which the reading arrives; None is all.
    """

    F: Float[Array, "run n n"]
    G: Float[Array, "... n k"]
    seen: Sequence[tuple[str, Float[Array, "run m n"], Mask | None]]


@dataclass(frozen=True, eq=False)
class Motion:
    """A system with its motion.

    Attributes:
        system: with sensor errors and drawn parameters as further states.
        names, units: of all coordinates.
        root: a square root of the covariance at the start, its nonzero columns only.
        times: s.
        x: true states, of the robot alone.
        u: controls.
        readings: what is read.
    """

    system: Linearized
    names: tuple[str, ...]
    units: tuple[str, ...]
    root: Float[Array, "n r"]
    times: Float[Array, " time"]
    x: Float[Array, "time run nx"]
    u: Float[Array, "time-1 run nu"]
    readings: Sequence[Reading]

    @property
    def std(self) -> Float[Array, " n"]:
        """Standard deviations at the start."""
        return np.linalg.norm(self.root, axis=1)

    def steps(self) -> Iterator[Step]:
        """The steps, one after the other; Jacobians that are not finite are NaN."""
        at: list[list[Reading]] = [[] for _ in self.times]
        for reading in self.readings:
            at[reading.taken].append(reading)
        with quiet():
            for k in range(1, len(self.times)):
                t, end = float(self.times[k - 1]), float(self.times[k])
                x, u = self.x[k], self.u[k - 1]
                F, G = self.system.transition(self.x[k - 1], x, u, t, end - t)
                groups = list(dict.fromkeys(reading.channels for reading in at[k]))
                found = whitened(self.system, k, groups, x, u, end)
                seen = []
                for reading in at[k]:
                    W, first = found[k, reading.channels], 0
                    for name in reading.channels or ("",):
                        width = self.system.output((name,) if name else None).n
                        seen.append((name, W[:, first : first + width], reading.mask))
                        first += width
                yield Step(F, G, seen)


def of_run(setup: Setup, run: int = 0) -> Motion:
    """The motion of one run of an experiment, with the readings that it had.

    Raises:
        ScenarioError: a channel has no white noise, or the truth of the run failed.
    """
    check(setup)
    happened = recording.trajectory(setup, [run])
    if not np.isfinite(happened.x).all():
        raise ScenarioError(f"the truth of run {run} fails; choose another --run")
    system, root = true_system(setup, [run])
    read = readings(setup, happened.deliveries, [0])
    used = root[:, root.any(axis=0)]
    return Motion(system, *labels(setup), used, setup.times, happened.x, happened.u, read)


def check(setup: Setup) -> None:
    """Refuse channels of which a reading has infinite information.

    Raises:
        ScenarioError: a channel has no white noise.
    """
    exact = [c.name for c in setup.channels if not is_positive_definite(c.cov)]
    if exact:
        raise ScenarioError(
            f"{', '.join(exact)} without white noise: a reading has infinite information; give "
            "each a channels.NAME.noise above 0"
        )


def labels(setup: Setup) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units of the state, of the drawn parameters and of the sensors' errors."""
    names, units = list(setup.space.names), list(setup.space.units)
    if setup.scenario.bound != "known":
        names += list(setup.scenario.truth.draw)
        units += ["σ"] * len(setup.scenario.truth.draw)
    for channel in setup.channels:
        space = channel.space
        for error in errors(channel):
            axes = space.names
            if error.kind == "misalignment":
                axes = tuple(f"{channel.name}.{axis}" for axis in "xyz")
            names += [f"{error.kind}.{channel.name if space.n == 1 else axis}" for axis in axes]
            plain = error.kind in ("bias", "drift")
            units += list(space.units) if plain else ["1"] * len(axes)
    return tuple(names), tuple(units)
