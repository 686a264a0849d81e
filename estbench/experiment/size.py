"""Refusal of experiments that no machine finishes or holds, by arithmetic, before their first step.

The figures are lower bounds: what they refuse takes longer, or more memory.
"""

import contextlib
from pathlib import Path
from typing import Any

import mujoco

from estbench.errors import EstimatorError, ScenarioError
from estbench.experiment.prepared import Setup
from estbench.scenario.believed import believed
from estbench.scenario.schema import Scenario

PHYSICS_STEP = 5e-7
"""s that a physics step takes at least: that of a pendulum on one core."""
LONGEST_STEP = 1.0
"""s that one control step of one run may take at least; no part of it can be shared by cores."""
LONGEST_WORK = 100 * 86400.0
"""s of one core that all runs may take at least."""
COPIES = 4
"""Arrays of the size of a belief that exist at once in a step."""
RUN_BYTES = 400
"""Memory of the averages of a run and an estimator at least."""


def check_steps(scenario: Scenario, spec: mujoco.MjSpec) -> None:
    """Refuse more physics steps than can be computed, before a model is compiled.

    Args:
        scenario: says the timesteps, the duration and the count of runs.
        spec: the robot, for its own timestep.

    Raises:
        ScenarioError: one control step, or all runs, would take too long; or the averages of all
            runs exceed the free memory.
    """
    model, simulation = scenario.model, scenario.simulation
    timestep = model.timestep or float(spec.option.timestep)
    if not timestep > 0:  # refused once the model is compiled
        return
    period = model.frame_skip * timestep
    counts = {f"model.frame_skip is {model.frame_skip}: one control step": float(model.frame_skip)}
    for label in scenario.estimators:
        section = believed(scenario, label)
        own = section.timestep or timestep
        counts[f"filter.timestep of {label} is {own:g} s: one control step"] = period / own
    for what, count in counts.items():
        if count * PHYSICS_STEP > LONGEST_STEP:
            raise ScenarioError(
                f"{what} is {count:.3g} physics steps, at least {count * PHYSICS_STEP:.3g} s of "
                f"computation in each run (at most {LONGEST_STEP:g}); use fewer"
            )
    steps = simulation.runs * max(1.0, simulation.duration / period) * sum(counts.values())
    if steps * PHYSICS_STEP > LONGEST_WORK:
        raise ScenarioError(
            f"{simulation.runs} runs of {simulation.duration:g} s with {len(scenario.estimators)} "
            f"estimators are {steps:.3g} physics steps, at least "
            f"{steps * PHYSICS_STEP / 86400:.3g} days of one core (at most "
            f"{LONGEST_WORK / 86400:g}); lower simulation.runs or simulation.duration"
        )
    _check_memory(
        simulation.runs * len(scenario.estimators) * RUN_BYTES,
        f"the averages of {simulation.runs} runs", "lower simulation.runs",
    )  # fmt: skip


def check_estimator(setup: Setup, label: str, estimator: Any) -> None:
    """Refuse an estimator whose points or covariances cannot be computed or held.

    Args:
        setup: the experiment.
        label: of the estimator.
        estimator: with `size` where it holds points, and `substeps` where it divides a step.

    Raises:
        EstimatorError: a step of one run would take too long, or its belief exceeds the memory.
    """
    space, runs = setup.space, min(10, setup.scenario.simulation.runs)
    factors = {name: getattr(estimator, name, 1) for name in ("size", "substeps")}
    count = 1.0
    for name, factor in factors.items():
        if isinstance(factor, int) and factor > 1:
            count *= factor
            if count * PHYSICS_STEP > LONGEST_STEP:
                raise EstimatorError(
                    f"{label}: {name} is {factor}: one step takes at least "
                    f"{count * PHYSICS_STEP:.3g} s in each run (at most {LONGEST_STEP:g}); lower it"
                )
    points = factors["size"] if isinstance(factors["size"], int) else 1
    _check_memory(
        8 * COPIES * runs * (points * space.nx + space.n**2),
        f"{label}: the beliefs of {runs} runs in {space.n} dimensions",
        "take fewer points, coordinates or --runs",
    )


def _check_memory(needed: int, what: str, remedy: str) -> None:
    free = free_memory()
    if free is not None and needed > free:
        raise ScenarioError(
            f"{what} take at least {needed / 2**30:.3g} GiB of memory, and {free / 2**30:.3g} are "
            f"free; {remedy}"
        )


def free_memory() -> int | None:
    """Bytes available without swapping, None where the system does not tell."""
    found = []
    with contextlib.suppress(OSError, ValueError, IndexError):
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        found += [1024 * int(x.split()[1]) for x in lines if x.startswith("MemAvailable")]
    with contextlib.suppress(OSError, ValueError):  # a container's limit, perhaps "max"
        group = Path("/sys/fs/cgroup")
        limit, used = (int((group / f"memory.{x}").read_text()) for x in ("max", "current"))
        found.append(limit - used)
    return min(found, default=None)
