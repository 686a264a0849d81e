"""`estbench.design`: what each sensor buys, and the cheapest suite that meets a requirement."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estbench.consistency.intervals import Interval
from estbench.errors import ScenarioError
from estbench.experiment.prepared import Setup
from estbench.experiment.setup import build
from estbench.montecarlo import run as running
from estbench.montecarlo.dispatch import Progress
from estbench.scenario.load import resolve
from estbench.scenario.schema import Scenario
from estbench.shapes import Array, Float
from estbench.suites import requirement
from estbench.suites.along import of_run
from estbench.suites.covariance import Course, Shown
from estbench.suites.search import MOST, Chosen, cheapest, greedy, pruned

RUNS = 50
"""Of the Monte Carlo that confirms the chosen suite."""
HALF_NOISE, TWICE_THE_RATE = 2.0, float(np.sqrt(2.0))
"""Factors on R^(-1/2). Two readings in place of one count as one of half the variance."""
CHANGES = {"without": 0.0, "half noise": HALF_NOISE, "double rate": TWICE_THE_RATE}
"""What is changed of one channel -> the factor."""


@dataclass(frozen=True, eq=False)
class Design:
    """What the channels of a scenario buy, and a suite of them.

    Standard deviations are roots of mean variances over time, as an RMSE is.

    Attributes:
        scenario: its name.
        estimator: the label of the one that confirms the suite.
        names, units: of the coordinates.
        candidates: channels that may be left out.
        always: channels that are in every suite.
        cost: of each channel.
        required: coordinate -> the largest σ allowed.
        all: σ with all channels.
        changed: change -> channel -> σ with all channels and this change of the one.
        order: the candidates, each the one that adds most information.
        information: with the first k of them, nats; k from 0 on.
        growing: σ with the first k of them.
        chosen: the channels of the suite.
        exhaustive: whether no cheaper suite of the candidates meets the requirement.
        std: σ that the suite is predicted to reach.
        rmse: that the estimator reaches with it; None where no run was asked for.
        verdict: of these runs.
    """

    scenario: str
    estimator: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    candidates: tuple[str, ...]
    always: tuple[str, ...]
    cost: Mapping[str, float]
    required: Mapping[str, float]
    all: Float[Array, " n"]
    changed: Mapping[str, Mapping[str, Float[Array, " n"]]]
    order: tuple[str, ...]
    information: Float[Array, " k"]
    growing: Float[Array, "k n"]
    chosen: tuple[str, ...]
    exhaustive: bool
    std: Float[Array, " n"]
    rmse: tuple[Interval, ...] | None = None
    verdict: str = ""

    @property
    def total_cost(self) -> float:
        """Of the suite."""
        return sum(self.cost[name] for name in self.chosen)


def design(
    scenario: str | Path | Scenario,
    require: str | Mapping[str, float],
    estimator: str | type | None = None,
    *,
    channels: Sequence[str] = (),
    run: int = 0,
    runs: int = RUNS,
    seed: int | None = None,
    duration: float | None = None,
    overrides: Sequence[str] = (),
    workers: int | None = None,
    progress: Progress | None = None,
) -> Design:
    """The cheapest suite of sensors with which σ is small enough, and what each sensor buys.

    Examples:
        >>> import estbench
        >>> found = estbench.design("pendulum", "hinge=0.01", duration=0.5, runs=0)
        >>> found.chosen
        ('encoder',)

    Args:
        scenario: a bundled name, a TOML or MJCF path, a results folder, or a `Scenario`.
        require: coordinate or pattern -> the largest σ, in its unit, or `root.x=0.01,...`.
        estimator: that confirms the suite: a label, name or class; default the scenario's first.
        channels: patterns of the candidates, default all; the others are always there.
        run: number of the true run along which the suites are compared.
        runs: of the Monte Carlo that confirms the suite; 0 for none.
        seed: in place of the scenario's.
        duration: s, in place of the scenario's.
        overrides: `section.key=value` strings.
        workers: count of threads of the Monte Carlo.
        progress: called with the count of finished runs of the Monte Carlo, and of all.

    Raises:
        ScenarioError: no suite meets the requirement, or a name is unknown.
        EstbenchError: the input is wrong otherwise.
    """
    named = None if estimator is None else [estimator]
    resolved = resolve(scenario, named, None, seed, duration, overrides)
    label = next(iter(resolved.estimators))
    one = resolved.model_copy(update={"estimators": {label: resolved.estimators[label]}})
    given = requirement.parse(require) if isinstance(require, str) else require
    if run < 0 or runs < 0:
        raise ScenarioError(f"--run is {run} and --runs {runs}; use numbers of at least 0")
    setup = build(one)
    found = of_setup(setup, given, channels, run)
    if not runs:
        return found
    simulation = one.simulation.model_copy(update={"runs": runs})
    trial = requirement.with_channels(one, found.chosen)
    trial = trial.model_copy(update={"simulation": simulation, "bound": False})
    (summary,) = running.run(trial, workers=workers, progress=progress).summaries
    return Design(**{**vars(found), "rmse": summary.rmse, "verdict": str(summary.verdict)})


def of_setup(
    setup: Setup, require: Mapping[str, float], channels: Sequence[str] = (), run: int = 0
) -> Design:
    """As `design`, of an experiment, without a Monte Carlo.

    Raises:
        ScenarioError: as `design`.
    """
    names, every = setup.space.names, tuple(c.name for c in setup.channels)
    limits = requirement.required(require, names)
    free = requirement.candidates(channels, every)
    always = tuple(name for name in every if name not in free)
    course = Course.of(of_run(setup, run), setup.scenario.consistency.burn_in)
    whole = dict.fromkeys(every, 1.0)
    changes = [(change, name) for change in CHANGES for name in free]
    trials = [whole, *({**whole, name: CHANGES[change]} for change, name in changes)]
    shown = _std(course.shown(trials), len(names))
    _check(limits, names, shown[0], setup.space.units)
    bound = np.array([limits.get(name, np.inf) for name in names])

    def suites(chosen: Sequence[Chosen]) -> Shown:
        return course.shown([{n: 1.0 for n in every if n in c or n in always} for c in chosen])

    def meets(chosen: Sequence[Chosen]) -> list[bool]:
        reached = _std(suites(chosen), len(names))
        return [bool((std <= bound).all()) for std in reached]

    order, _ = greedy(free, lambda chosen: suites(chosen).information)
    heads = suites([frozenset(order[:k]) for k in range(len(order) + 1)])
    cost = requirement.costs(setup.scenario, every)
    exhaustive = len(free) <= MOST
    best = cheapest(free, cost, meets) if exhaustive else pruned(order, cost, meets)
    by_change = {
        change: {n: s for (c, n), s in zip(changes, shown[1:]) if c == change} for change in CHANGES
    }
    return Design(
        setup.scenario.name, next(iter(setup.scenario.estimators)), names, setup.space.units, free,
        always, cost, limits, shown[0], by_change, tuple(order), heads.information,
        _std(heads, len(names)), tuple(n for n in every if n in best or n in always), exhaustive,
        _std(suites([best]), len(names))[0],
    )  # fmt: skip


def _std(shown: Shown, n: int) -> Float[Array, "suite n"]:
    """Standard deviations of the state, without drawn parameters and errors of sensors."""
    return np.sqrt(shown.mse[:, :n])


def _check(
    limits: Mapping[str, float],
    names: Sequence[str],
    std: Float[Array, " n"],
    units: Sequence[str],
) -> None:
    """Refuse what all channels together do not reach.

    Raises:
        ScenarioError: a coordinate cannot be reached.
    """
    short = [
        f"{name} = {limits[name]:g} {unit} (all reach {reached:.3g} {unit})"
        for name, unit, reached in zip(names, units, std)
        if reached > limits.get(name, np.inf)
    ]
    if short:
        raise ScenarioError(
            f"no suite of the channels reaches {', '.join(short)}; relax --require, add channels, "
            "or raise consistency.burn_in to leave out the start"
        )
