"""The cost of a task under one controller that sees the truth, estimates, or raw readings.

Disturbances and sensor noises are common random numbers: row i has those of run i of the seed.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estbench.consistency.intervals import Interval, mean_interval
from estbench.envs.errors import EnvError
from estbench.envs.world import World, prepare
from estbench.errors import did_you_mean
from estbench.montecarlo import run as experiment
from estbench.montecarlo.executors import cpu_count
from estbench.scenario.load import Chosen
from estbench.scenario.schema import Scenario
from estbench.shapes import Array
from estbench.simulation import controllers, kinds
from estbench.simulation.controllers import Controller

TRUTH, RAW = "truth", "raw"


@dataclass(frozen=True, eq=False)
class Outcome:
    """Costs and failures of the controller with one source of states.

    Attributes:
        label: `truth`, `raw` or an estimator's.
        cost: mean cost per step of each run, up to its failure `(run,)`.
        failed: runs that left the bounds or are no longer finite `(run,)`.
        failed_at: time of the failure, s; NaN for the others `(run,)`.
    """

    label: str
    cost: Array
    failed: NDArray[np.bool_]
    failed_at: Array


@dataclass(frozen=True, eq=False)
class Comparison:
    """The sources side by side; `estbench.envs.control_table` prints it.

    Attributes:
        scenario: its name.
        controller: its kind.
        seed: of the runs.
        duration: s.
        level: of the intervals.
        sources: truth, estimators, raw.
    """

    scenario: str
    controller: str
    seed: int
    duration: float
    level: float
    sources: tuple[Outcome, ...]

    def __getitem__(self, label: str) -> Outcome:
        return {s.label: s for s in self.sources}[label]

    def cost(self, label: str) -> Interval:
        """Mean cost per step with its interval, over the runs that did not fail."""
        source = self[label]
        return mean_interval(source.cost[~source.failed], self.level)

    def difference(self, label: str, reference: str) -> Interval:
        """Paired difference of cost, over the runs that failed with neither."""
        a, b = self[label], self[reference]
        both = ~a.failed & ~b.failed
        return mean_interval((a.cost - b.cost)[both], self.level)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers for JSON; what is not finite becomes None."""
        return {
            "scenario": self.scenario,
            "controller": self.controller,
            "seed": self.seed,
            "duration_s": self.duration,
            "runs": len(self.sources[0].cost),
            "sources": {
                s.label: {
                    "failures": int(s.failed.sum()),
                    "cost": _plain(self.cost(s.label)),
                    "minus_truth": _plain(self.difference(s.label, TRUTH)),
                    "minus_raw": _plain(self.difference(s.label, RAW)),
                }
                for s in self.sources
            },
        }


def compare(
    scenario: str | Path | Scenario,
    estimators: Chosen | None = None,
    *,
    controller: str | None = None,
    runs: int = 100,
    seed: int | None = None,
    duration: float | None = None,
    overrides: Sequence[str] = (),
    progress: Callable[[int, int], None] | None = None,
) -> Comparison:
    """Run a controller on the truth, on each estimator's estimate and on raw readings.

    Args:
        scenario: bundled name, path or `Scenario`; its `[task]` gives cost, bounds and horizon.
        estimators: labels, names or classes in place of the scenario's; one needs no list.
        controller: kind in place of the scenario's (`estbench list` shows them).
        runs: how many.
        seed: of the runs, as of `estbench run`; default the scenario's.
        duration: s, in place of the task's horizon.
        overrides: `section.key=value` strings.
        progress: called with the steps done and the steps in all.

    Raises:
        EstbenchError: a setting is wrong; raised before the simulation.
    """
    if runs < 1:
        raise EnvError(f"runs is {runs}; use at least 1")
    if controller is not None:
        if controller not in kinds.KINDS:
            hint = did_you_mean(controller, kinds.KINDS)
            raise EnvError(f"no controller '{controller}'{hint}")
        overrides = [f"control.kind={controller}", *overrides]
    if duration is not None:
        overrides = [f"task.horizon={duration}", *overrides]
    resolved = experiment.resolve(scenario, estimators, overrides=overrides)
    for label in resolved.estimators:
        if label in (TRUTH, RAW):
            raise EnvError(f"estimators.{label}: the label '{label}' is taken; choose another")
    tables = {TRUTH: None} | {k: {"type": k, **v} for k, v in resolved.estimators.items()}
    tables |= {RAW: {"type": "estbench.envs.raw:RawReadings"}}
    threads = cpu_count()
    worlds = {
        label: World(prepare(resolved, table, None, ()), runs, table is not None, threads)
        for label, table in tables.items()
    }
    first = worlds[TRUTH]
    steps, begin = first.task.steps, resolved.simulation.seed if seed is None else seed
    control = controllers.checked(
        controllers.build(resolved.control, first.setup.plant, begin, range(runs), steps),
        resolved.control.kind,
        first.setup.plant.model.nu,
    )
    sources = []
    for done, (label, world) in enumerate(worlds.items()):
        tick = progress and (lambda k, at=done: progress(at * steps + k, steps * len(worlds)))
        sources.append(_drive(label, world, control, begin, tick))
    return Comparison(
        scenario=resolved.name,
        controller=resolved.control.kind,
        seed=begin,
        duration=steps * first.setup.plant.period,
        level=resolved.consistency.level,
        sources=tuple(sources),
    )


def _drive(
    label: str,
    world: World,
    control: Controller,
    seed: int,
    progress: Callable[[int], None] | None,
) -> Outcome:
    """One episode of all runs; the controller sees the truth or the estimates."""
    runs, period = world.rows, world.setup.plant.period
    world.reset(np.arange(runs), seed, range(runs))
    total, count = np.zeros(runs), np.zeros(runs)
    failed_at = np.full(runs, np.nan)
    seen = world.x.copy()
    for k in range(world.task.steps):
        alive = np.isnan(failed_at)
        now = world.x if world.filter is None else world.filter.estimate
        finite = np.isfinite(now).all(axis=-1)
        seen[finite] = now[finite]
        world.step(control(k, k * period, seen))
        cost = world.task.cost(world.x, world.u)
        out = world.task.outside(world.x) & alive
        total[alive] += np.nan_to_num(cost[alive])
        count[alive] += 1
        failed_at[out] = (k + 1) * period
        if progress is not None:
            progress(k + 1)
    return Outcome(label, total / np.maximum(count, 1), ~np.isnan(failed_at), failed_at)


def _plain(i: Interval) -> dict[str, float | None]:
    values = {"value": i.value, "low": i.low, "high": i.high}
    return {k: float(v) if np.isfinite(v) else None for k, v in values.items()}
