"""`estbench.budget`: the error budget of one estimator of a scenario."""

from collections.abc import Sequence
from pathlib import Path

from estbench.budgets.linear import RUNS, linear
from estbench.budgets.montecarlo import sampled
from estbench.budgets.result import Budget
from estbench.budgets.sources import CONDITIONS, sources
from estbench.errors import EstbenchError, EstimatorError
from estbench.experiment.prepared import Setup
from estbench.experiment.setup import build
from estbench.montecarlo.dispatch import Progress
from estbench.scenario.load import resolve
from estbench.scenario.schema import Scenario


def budget(
    scenario: str | Path | Scenario,
    estimator: str | type | None = None,
    *,
    monte_carlo: bool = False,
    by_source: bool = False,
    runs: int | None = None,
    seed: int | None = None,
    duration: float | None = None,
    overrides: Sequence[str] = (),
    workers: int | None = None,
    progress: Progress | None = None,
) -> Budget:
    """How much of an estimator's error each source causes.

    By linear covariance analysis: the filter's own gains along a few true runs propagate the error
    of each source by itself. By Monte Carlo too, where it is asked for: each source alone, and all
    but each. See docs/budgets.md.

    Examples:
        >>> import estbench
        >>> found = estbench.budget("pendulum", "ekf", duration=0.5).dataset()
        >>> found.share.sel(coordinate="hinge.vel").idxmax().item()
        'gyro.noise'

    Args:
        scenario: a bundled name, a TOML or MJCF path, a results folder, or a `Scenario`.
        estimator: a label, name or class; default the scenario's first.
        monte_carlo: whether to run the Monte Carlo.
        by_source: whether each coordinate of the initial error and each component of the process
            noise is a source; else these are one source each.
        runs: of the Monte Carlo, or without it of the linear analysis, of which the default is 8.
        seed: in place of the scenario's.
        duration: s, in place of the scenario's.
        overrides: `section.key=value` strings.
        workers: count of threads of the Monte Carlo.
        progress: called with the count of finished runs of the Monte Carlo, and of all.

    Raises:
        EstimatorError: the estimator has no gain, and no Monte Carlo was asked for.
        EstbenchError: the input is wrong otherwise.
    """
    resolved = resolve(
        scenario, None if estimator is None else [estimator], runs, seed, duration, overrides
    )
    return of_setup(build(one(resolved)), monte_carlo, by_source, runs, workers, progress)


def one(scenario: Scenario) -> Scenario:
    """The scenario with its first estimator alone."""
    first = dict(list(scenario.estimators.items())[:1])
    return scenario.model_copy(update={"estimators": first})


def of_setup(
    setup: Setup,
    monte_carlo: bool = False,
    by_source: bool = False,
    runs: int | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Budget:
    """As `budget`, of an experiment with one estimator.

    Raises:
        EstbenchError: as `budget`.
    """
    (label,) = setup.scenario.estimators
    along = RUNS if runs is None or monte_carlo else runs
    notices, analysed = [], None
    try:
        analysed = linear(setup, label, along)
    except EstimatorError as error:
        if not monte_carlo:
            raise
        notices.append(f"no linear budget: {error}")
    if not (setup.scenario.simulation.runs > 1 or not monte_carlo):
        raise EstbenchError("--runs is 1, which gives no intervals; use at least 2")
    found = None
    if monte_carlo:
        found = sampled(setup, label, by_source=by_source, workers=workers, progress=progress)
    if analysed is not None:
        notices.append(f"linear analysis along {analysed.runs} true runs")
        if analysed.left_out:
            names = ", ".join(source.name for source in analysed.left_out)
            notices.append(f"not linear, and so left out of the linear analysis: {names}")
    taken = [s.name for s in sources(setup, label) if s.kind in CONDITIONS]
    if taken:
        notices.append(f"{', '.join(taken)} adds no error, but changes what the sources contribute")
    return Budget(
        setup.scenario.name, label, setup.space.names, setup.space.units, setup.times,
        setup.scenario.consistency.burn_in, analysed, found, by_source, tuple(notices),
    )  # fmt: skip
