"""`estbench.observability`: what the sensors of a scenario see along the truth's motion."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estbench.budgets.sources import sources
from estbench.budgets.switches import without
from estbench.errors import ScenarioError
from estbench.experiment.prepared import Setup
from estbench.experiment.setup import build
from estbench.scenario.load import resolve
from estbench.scenario.schema import Scenario
from estbench.shapes import Array, Float
from estbench.suites.along import Motion, of_run
from estbench.suites.gramian import gathered, left
from estbench.suites.motions import kept, tried
from estbench.suites.words import echelon, said

SEEN = 1.0
"""Information, in units of the prior's, from which on a direction counts as seen: σ is 0.71."""
CHECKS = 16
"""Times at which it is looked, closer to each other at the start."""
SHOWS = 0.7
"""A motion shows a direction if it leaves less than this of its standard deviation."""


@dataclass(frozen=True)
class Direction:
    """A direction of the state at the start, in units of the prior's standard deviations.

    Attributes:
        text: in words.
        vector: of length 1.
        seen_from: s; None where it is not seen up to the end.
        left: what is left of its standard deviation at the end.
        shown_by: motions that would show it, the best first, with what they leave; empty for one
            that is seen.
    """

    text: str
    vector: Float[Array, " r"]
    seen_from: float | None
    left: float
    shown_by: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True, eq=False)
class Observability:
    """What is seen along one motion.

    Attributes:
        scenario: its name.
        names, units: of the state, of drawn parameters and of errors of sensors.
        std: at the start.
        window: s.
        eigenvalues: information at the end, falling.
        left: of each coordinate the standard deviation at the end over that at the start; NaN for
            one that is known at the start.
        seen_from: s, of each coordinate; NaN where it is not seen.
        directions: those not seen at the first look, the last seen first.
    """

    scenario: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    std: Float[Array, " n"]
    window: float
    eigenvalues: Float[Array, " r"]
    left: Float[Array, " n"]
    seen_from: Float[Array, " n"]
    directions: tuple[Direction, ...]

    @property
    def never(self) -> tuple[Direction, ...]:
        """The directions that are not seen in the window."""
        return tuple(d for d in self.directions if d.seen_from is None)


def observability(
    scenario: str | Path | Scenario,
    *,
    window: float | None = None,
    run: int = 0,
    motions: bool = True,
    seed: int | None = None,
    overrides: Sequence[str] = (),
) -> Observability:
    """What the sensors see of the state, along the motion of one true run without process noise.

    Examples:
        >>> import estbench
        >>> found = estbench.observability("pendulum", window=0.5, motions=False)
        >>> len(found.never)
        0

    Args:
        scenario: a bundled name, a TOML or MJCF path, a results folder, or a `Scenario`.
        window: s from the start, in place of the scenario's duration.
        run: number of the run.
        motions: whether to try motions that would show what is not seen.
        seed: in place of the scenario's.
        overrides: `section.key=value` strings.

    Raises:
        ScenarioError: a channel has no white noise, the run fails, or P₀ is zero.
        EstbenchError: the input is wrong otherwise.
    """
    resolved = resolve(scenario, None, None, seed, window, overrides)
    if run < 0:
        raise ScenarioError(f"--run is {run}; use a number of at least 0")
    return of_setup(build(resolved), run, motions)


def of_setup(setup: Setup, run: int = 0, motions: bool = True) -> Observability:
    """As `observability`, of an experiment.

    Raises:
        ScenarioError: as `observability`.
    """
    motion = of_run(_undisturbed(setup), run)
    if not motion.std.any():
        raise ScenarioError("initial.std is 0 for every coordinate: there is nothing to observe")
    found = of_motion(setup.scenario.name, motion)
    if not (motions and found.never):
        return found
    names, trials = tried(setup)
    *_, last = gathered(trials)
    shown = [_shown(d, names, kept(last, d.vector)) for d in found.directions]
    return Observability(**{**vars(found), "directions": tuple(shown)})


def _undisturbed(setup: Setup) -> Setup:
    """The experiment without process noise.

    Kept as a known input, the noise of a run would be a force whose direction in the world is
    known: the sensors of a robot, which feel it in the robot's axes, would see the heading.
    """
    label = next(iter(setup.scenario.estimators))
    return without(setup, label, [s for s in sources(setup, label) if s.kind == "process"])


def of_motion(name: str, motion: Motion) -> Observability:
    """What is seen along a motion of one run.

    Raises:
        ScenarioError: the Jacobians along it are not finite.
    """
    count = len(motion.times)
    looks = np.unique(np.geomspace(1, count - 1, CHECKS).astype(int)).tolist()
    infos, std = [], motion.std
    ratio = np.empty((count, len(std)))
    for k, information in enumerate(gathered(motion)):
        if not np.isfinite(information).all():
            raise ScenarioError(
                f"the Jacobians along the motion are not finite at {motion.times[k]:g} s"
            )
        ratio[k] = left(information[0], motion.root)
        if k in looks:
            infos.append(information[0])
    below = ratio <= 1.0 / np.sqrt(1.0 + SEEN)
    first = motion.times[below.argmax(axis=0)]
    values = np.asarray(np.linalg.eigvalsh(infos[-1]), np.float64)
    return Observability(
        name, motion.names, motion.units, std, float(motion.times[-1]), values[::-1], ratio[-1],
        np.where(below.any(axis=0), first, np.nan),
        _directions(infos, motion.times[looks], motion),
    )  # fmt: skip


def _directions(
    infos: Sequence[Float[Array, "r r"]], times: Float[Array, " look"], motion: Motion
) -> tuple[Direction, ...]:
    """From the last look back: what was not seen before, and is then."""
    known = np.zeros((motion.root.shape[1], 0))  # what is hidden at the later look
    out: list[Direction] = []
    last, scale = infos[-1], np.where(motion.std > 0, motion.std, 1.0)
    for k in reversed(range(len(infos))):
        values, vectors = np.linalg.eigh(infos[k])
        hidden = vectors[:, values < SEEN]
        rest = hidden - known @ (known.T @ hidden)
        extra = hidden.shape[1] - known.shape[1]
        if extra <= 0:
            continue
        u, _, _ = np.linalg.svd(rest, full_matrices=False)
        fresh = u[:, :extra]
        seen_from = None if k + 1 == len(infos) else float(times[k + 1])
        for vector in echelon(fresh).T:
            remaining = float(kept(last[None], vector)[0])
            out.append(Direction(said(motion.root @ vector / scale, motion.names), vector,
                                 seen_from, remaining))  # fmt: skip
        both = np.linalg.qr(np.concatenate([known, fresh], axis=1))[0]
        known = np.asarray(both, np.float64)
    return tuple(out)


def _shown(d: Direction, names: Sequence[str], remaining: Float[Array, " run"]) -> Direction:
    """With the motions that show it, two at most."""
    if d.seen_from is not None:
        return d
    order = np.argsort(np.where(np.isfinite(remaining), remaining, np.inf), kind="stable").tolist()
    best = [(names[i], float(remaining[i])) for i in map(int, order[:2]) if remaining[i] < SHOWS]
    return Direction(d.text, d.vector, d.seen_from, d.left, tuple(best))
