"""`estbench.tune`: the free parameters of an estimator, fitted on simulated runs."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from estbench.consistency.innovations import FEWEST
from estbench.errors import Interrupted, StoreError, StudyError, shown
from estbench.experiment.setup import build
from estbench.scenario.load import resolve
from estbench.scenario.schema import Scenario
from estbench.shapes import Array
from estbench.store import folders
from estbench.study import keys
from estbench.tuning import freedom, heldout, heldout_logs, logged, search
from estbench.tuning.evaluation import Evaluation, Simulated
from estbench.tuning.logged import LogFiles
from estbench.tuning.memory import Memory
from estbench.tuning.objective import Kind, Objective
from estbench.tuning.parameters import Free, Parameter, Prior, parse, values_at, with_priors
from estbench.tuning.problem import Problem
from estbench.tuning.result import Tuned, tuned_scenario
from estbench.tuning.uncertainty import Profile, Uncertainty, profiles, uncertainty

EVALUATIONS, SCENARIO, RESULT = "evaluations", "tuned.toml", "tuned.json"
START = "start.toml"
"""The scenario before the tuning and the free keys, in the folder of its results."""
Method = Literal["auto", "quasi-newton", "nelder-mead", "evolution", "optuna"]
FreeSpec = str | Free


def tune(
    scenario: str | Path | Scenario,
    estimator: str | type,
    free: Sequence[FreeSpec],
    *,
    objective: Kind = "likelihood",
    coordinates: Mapping[str, float] | None = None,
    priors: Mapping[str, tuple[float, float]] | None = None,
    method: Method = "auto",
    iterations: int = 60,
    runs: int | None = None,
    seed: int | None = None,
    duration: float | None = None,
    overrides: Sequence[str] = (),
    held_out: int | None = None,
    logs: Sequence[LogFiles] = (),
    held_out_logs: Sequence[LogFiles] = (),
    hold_out: Sequence[str] = (),
    out: str | Path | None = None,
    resume: bool = False,
    workers: int | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Tuned:
    """Fit what an estimator believes, or its settings, and prove the result on other runs.

    With `logs` the readings are those of recorded logs instead: the likelihood of each block of
    time takes the place of that of a run, and keys of `[log]` may be free too.

    The loss is that of the same runs for every candidate (common random numbers): truth and
    readings are simulated once. Then the estimator before and after runs on as many held-out runs.

    Examples:
        >>> import estbench
        >>> start = ["filter.measurement_noise_scale=100"]
        >>> tuned = estbench.tune("pendulum", "ekf", ["filter.measurement_noise_scale"], runs=8,
        ...                       duration=0.2, overrides=start, held_out=0)
        >>> bool(0.7 < tuned["filter.measurement_noise_scale"] < 1.4)
        True

    Args:
        scenario: a bundled name, a TOML or MJCF path, a results folder, or a `Scenario`.
        estimator: label, name or class.
        free: `KEY`, `KEY=LOW:HIGH` or `KEY=A,B,C`; keys under `filter` and `start`, or settings of
            the estimator.
        objective: `likelihood` of the readings, `mse`, or `consistent-mse`, which keeps NEES/n
            within the tolerance of the verdict.
        coordinates: pattern -> weight of the relative squared errors of a `mse`; default all.
        priors: key -> (centre, spread), log-normal for positive parameters: the estimate is then
            the maximum a posteriori.
        method: `auto`: quasi-Newton where the loss is smooth, evolution where a parameter is
            rounded, optuna where it is a choice.
        iterations: at most; candidates for Nelder-Mead and optuna.
        runs: of the tuning, in place of the scenario's.
        seed: in place of the scenario's; the held-out runs have the next one.
        duration: s, in place of the scenario's.
        overrides: `section.key=value` strings: the filter before the tuning.
        held_out: count of held-out runs; default as many as runs; 0 leaves them out.
        logs: recorded logs, each a file or a list of the files of one log.
        held_out_logs: other logs, on which the filter before and after is judged.
        hold_out: channels of the logs that are predicted and not fused.
        out: folder of the tuned scenario, the result and all candidates; None writes nothing.
        resume: go on in `out`; no candidate is computed twice.
        workers: threads.
        progress: called with the count of candidates and the least loss.

    Raises:
        StudyError: a key does not exist, is not free to vary or needs a range; there are too few
            runs; the objective or method does not fit.
        EstbenchError: the input is wrong otherwise.
        Interrupted: Ctrl-C came before the first candidate was computed.
    """
    resolved = resolve(scenario, [estimator], runs, seed, duration, overrides)
    _check(free, coordinates, priors, iterations, held_out)
    (label,) = resolved.estimators
    recorded = logged.given(resolved, label, logs, hold_out, (runs, duration, held_out), objective)
    others = heldout_logs.given(resolved, label, recorded, held_out_logs, hold_out)
    prepared = build(resolved) if recorded is None else recorded.start
    parameters = with_priors(
        freedom.parameters(prepared, label, [parse(f) if isinstance(f, str) else f for f in free]),
        [(key, Prior(*spec)) for key, spec in (priors or {}).items()],
    )
    count = resolved.simulation.runs if recorded is None else recorded.runs
    if count < len(parameters) + 1:
        raise StudyError(
            f"{len(parameters)} free parameters need at least {len(parameters) + 1} "
            + (f"runs, got {count}; raise --runs" if recorded is None else
               f"blocks of {FEWEST} updates, got {count}; give a longer --log")
        )  # fmt: skip
    if recorded is None and objective == "likelihood" and resolved.control.observe == "estimate":
        raise StudyError(
            "the controller sees the estimate, so that each candidate has readings of its own, "
            "whose likelihoods do not compare; use --objective mse, or control.observe=reference"
        )
    names = tuple(p.names for p in parameters)
    used = () if recorded is None else tuple(log.name for log in recorded.logs)
    folder = _folder(out, resume, resolved, [*map(keys.show, names), *used])
    if recorded is not None:
        recorded.free = names
    source = recorded or Simulated(prepared, label, names, range(count), workers)
    memory = Memory(source, None if folder is None else folder / EVALUATIONS)
    note = progress or (lambda candidates, loss: None)
    found = fit(
        parameters, memory, objective=objective, coordinates=coordinates, method=method,
        iterations=iterations, seed=resolved.simulation.seed,
        tolerance=resolved.consistency.tolerance, progress=note,
    )  # fmt: skip
    compared, interrupted = None, found.interrupted
    wanted = count if held_out is None else held_out
    if wanted and not interrupted:
        try:
            compared = (
                heldout.compare(
                    resolved, label, parameters, found.values, resolved.simulation.seed + 1,
                    wanted, found.likelihood,
                ) if recorded is None else
                heldout_logs.compare(recorded, others, found.values, resolved.consistency.level)
            )  # fmt: skip
        except (Interrupted, KeyboardInterrupt):
            interrupted = True
    tuned = Tuned(
        scenario=tuned_scenario(resolved, parameters, found.values), label=label,
        objective=objective, method=found.method, parameters=parameters, values=found.values,
        point=found.point, loss=found.loss, runs=count, seed=resolved.simulation.seed,
        batches=memory.sets, candidates=len(memory.asked),
        trace=tuple(found.problem.trace),
        uncertainty=found.uncertainty, profiles=found.profiles, held_out=compared,
        interrupted=interrupted, refused=found.refused, folder=folder, logs=used,
    )  # fmt: skip
    if folder is not None:
        (folder / SCENARIO).write_text(tuned.to_toml(), encoding="utf-8")
        (folder / RESULT).write_text(tuned.to_json(), encoding="utf-8")
    return tuned


@dataclass(frozen=True, eq=False)
class Fit:
    """A finished or interrupted search.

    Attributes:
        problem: with its trace and best point.
        method: that was used.
        values, point: the best.
        loss: before and after.
        likelihood: log-likelihood of each run, after.
        uncertainty, profiles: where the search was smooth and not interrupted.
        refused: reason -> count of candidates.
        interrupted: whether Ctrl-C ended it.
    """

    problem: Problem
    method: str
    values: tuple[Any, ...]
    point: tuple[float, ...]
    loss: tuple[float, float]
    likelihood: Array
    uncertainty: Uncertainty | None
    profiles: tuple[Profile, ...]
    refused: dict[str, int]
    interrupted: bool


def fit(
    parameters: tuple[Parameter, ...],
    evaluate: Memory,
    *,
    objective: str = "likelihood",
    coordinates: Mapping[str, float] | None = None,
    method: str = "auto",
    iterations: int = 60,
    seed: int = 0,
    tolerance: float = 0.05,
    progress: Callable[[int, float], None] = lambda candidates, loss: None,
) -> Fit:
    """Search for the best values of parameters, whatever computes the candidates.

    For the arguments see `tune`.

    Args:
        parameters: the free ones.
        evaluate: computes candidates, simulated or on recorded readings, and remembers them.
        objective: `likelihood`, or one that needs the truth.
        coordinates: of a squared error.
        method: of the search.
        iterations: at most.
        seed: of a search that draws numbers.
        tolerance: of NEES/n, for the constraint.
        progress: called after each set of candidates.
    """
    start = [tuple(p.start for p in parameters)]
    first = _asked(lambda: evaluate(start))
    goal = Objective.build(objective, first, evaluate.names, dict(coordinates or {}), tolerance)
    problem = Problem(parameters, evaluate, goal, progress)
    kinds = {p.kind for p in parameters}
    used = search.chosen(kinds, goal.constrained) if method == "auto" else method
    spread: Uncertainty | None = None
    along: tuple[Profile, ...] = ()
    interrupted = False
    try:
        search.run(problem, method, seed, iterations)
        if problem.best[0] is not None and used == "quasi-newton":
            spread = uncertainty(problem, problem.best[0])
            along = profiles(problem, problem.best[0], spread)
    except KeyboardInterrupt:
        interrupted = True
    best = problem.best[0]
    if best is None:
        if interrupted:
            raise Interrupted("interrupted before the first candidates: there is no result")
        raise StudyError(
            "no candidate satisfies the constraint that NEES/n is within the tolerance; widen the "
            "ranges, free more, or raise consistency.tolerance"
            if goal.constrained
            else "every candidate failed; narrow the ranges of what is free"
        )
    (values,) = values_at(parameters, best[None])
    found = evaluate([values])
    reasons = Counter(r for v in evaluate.asked for r in evaluate([v]).reasons if r)
    return Fit(
        problem=problem, method=used, values=values, point=tuple(best.tolist()),
        loss=(float(goal.losses(first).mean()), float(goal.losses(found).mean())),
        likelihood=found.log_likelihood[0], uncertainty=spread, profiles=along,
        refused=dict(reasons.most_common(3)), interrupted=interrupted,
    )  # fmt: skip


def _asked(call: Callable[[], Evaluation]) -> Evaluation:
    """What a call answers; Ctrl-C means that there is no result."""
    try:
        return call()
    except KeyboardInterrupt:
        raise Interrupted("interrupted before the first candidate: there is no result") from None


def _check(
    free: object, coordinates: object, priors: object, iterations: Any, held_out: Any
) -> None:
    """Refuse settings of another type.

    Raises:
        StudyError: a setting has another type, or a count is too small.
    """
    if isinstance(free, str) or not isinstance(free, Sequence):
        raise StudyError(f"free is {shown(free)}; use a list of keys")
    for name, table in (("coordinates", coordinates), ("priors", priors)):
        if table is not None and not isinstance(table, Mapping):
            raise StudyError(f"{name} is {shown(table)}; use a table with the name as its key")
    for name, value, least in (("iterations", iterations, 1), ("held_out", held_out, 0)):
        whole = isinstance(value, int) and not isinstance(value, bool)
        if value is not None and not (whole and value >= least):
            raise StudyError(f"{name} is {shown(value)}; use a whole number of at least {least}")


def _folder(
    out: str | Path | None, resume: bool, scenario: Scenario, free: Sequence[str]
) -> Path | None:
    """The folder of the results, made or found.

    Raises:
        StoreError: it exists and is not resumed, or is of another tuning.
    """
    if out is None:
        if resume:
            raise StoreError("resume needs the folder that it fills; name it with --out")
        return None
    folder, toml = Path(out), f"# free: {', '.join(free)}\n\n{scenario.to_toml()}"
    try:
        folder.mkdir(parents=True, exist_ok=resume)
        known = folder / START
        if known.is_file() and known.read_text(encoding="utf-8") != toml:
            raise StoreError(
                f"{folder} is of another scenario or of other free keys; choose another --out"
            )
        known.write_text(toml, encoding="utf-8")
    except OSError as error:
        if folder.exists() and not resume:
            raise StoreError(folders.EXISTS.format(folder)) from None
        raise folders.unwritable(folder, error) from None
    return folder
