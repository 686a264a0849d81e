"""A study on workers: each task is one group of variants on one batch of runs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

from estbench.experiment.setup import Setup, build, variant
from estbench.montecarlo.dispatch import EXPERIMENTS, Progress
from estbench.montecarlo.pool import Pool, work_off
from estbench.scenario.load import parse
from estbench.study.design import Study
from estbench.study.evaluation import Outcome, evaluate, simulated

Piece = tuple[int, int]
"""Number of a group of variants, and of a batch of runs."""
Outcomes = Sequence[dict[str, Outcome]]
"""For each variant of a group, label -> record or the reason of a failure."""


@dataclass(frozen=True)
class Task:
    """The task of a worker.

    Attributes:
        piece: what it computes.
        tomls: the scenarios of the group.
        runs: first run and the one after the last.
        experiment: its number, as in `worker.Task`.
    """

    piece: Piece
    tomls: tuple[str, ...]
    runs: tuple[int, int]
    experiment: int = 0


def prepare(study: Study) -> list[list[Setup]]:
    """The experiments of each group; the first one is built, the others share its truth.

    Raises:
        EstbenchError: a variant cannot be run.
    """
    out = []
    for group in study.groups:
        first, *others = (study.variants[i] for i in group.ravel().tolist())
        base = build(first)
        out.append([base, *(variant(base, scenario) for scenario in others)])
    return out


def compute(
    prepared: Sequence[Sequence[Setup]],
    batches: Sequence[range],
    wanted: Sequence[Piece],
    using: Pool,
    keep: Callable[[Piece, Outcomes], None],
    progress: Progress | None = None,
) -> tuple[dict[Piece, Exception], bool]:
    """Compute some pieces.

    Args:
        prepared: the experiments of each group.
        batches: the runs of each batch.
        wanted: the pieces.
        using: the workers.
        keep: called with each piece as it is finished.
        progress: called with the count of finished estimator runs, and of all.

    Returns:
        Piece -> error of those that failed as a whole, and whether Ctrl-C came.
    """
    tomls = [tuple(s.scenario.to_toml() for s in group) for group in prepared]
    number = next(EXPERIMENTS)
    tasks = [Task((g, b), tomls[g], (batches[b].start, batches[b].stop), number) for g, b in wanted]
    size = {(g, b): len(prepared[g]) * len(batches[b]) for g, b in wanted}
    total, done = sum(size.values()), 0
    errors: dict[Piece, Exception] = {}

    def failed(task: Task, error: Exception) -> None:
        errors[task.piece] = error

    def finished(task: Task, result: Outcomes) -> None:
        nonlocal done
        keep(task.piece, result)
        done += size[task.piece]
        if progress is not None:
            progress(done, total)

    return errors, work_off(work, tasks, using, prepared, finished, failed)


def work(
    task: Task,
    stop: Callable[[], bool] = lambda: False,
    prepared: Sequence[Sequence[Setup]] | None = None,
) -> Outcomes | None:
    """Compute one piece: its truth once, then every estimator of every variant on it."""
    group = _built(task.tomls, task.experiment) if prepared is None else prepared[task.piece[0]]
    runs = range(*task.runs)
    return evaluate(group, runs, simulated(group[0], runs), stop)


@lru_cache(maxsize=2)
def _built(tomls: tuple[str, ...], experiment: int) -> Sequence[Setup]:
    base = build(parse(tomls[0]))
    return [base, *(variant(base, parse(toml)) for toml in tomls[1:])]
