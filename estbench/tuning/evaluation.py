"""Candidates on the same readings: what each gives in every run.

A search asks an `Evaluate` only. So it does not matter whether readings are simulated, as here, or
recorded: without truth `mse` and `anees` are None, and the likelihood remains.
"""

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from estbench.errors import EstbenchError
from estbench.experiment.setup import Setup, variant
from estbench.montecarlo import batch, executors
from estbench.shapes import Array, Float
from estbench.simulation.sources import Trajectory
from estbench.study import keys
from estbench.study.evaluation import evaluate, simulated

Values = tuple[Any, ...]
"""The values of a candidate, one per free parameter."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What some candidates gave.

    Attributes:
        log_likelihood: of all readings of each run; NaN where the candidate failed.
        mse: mean squared error over time, (unit)²; None without truth.
        anees: NEES/n averaged over time; None without truth.
        diverged: 1 for runs that diverged, else 0; None without truth.
        reasons: why a candidate was refused or failed as a whole, else "".
    """

    log_likelihood: Float[Array, "candidate run"]
    mse: Float[Array, "candidate run coordinate"] | None
    anees: Float[Array, "candidate run"] | None
    diverged: Float[Array, "candidate run"] | None
    reasons: tuple[str, ...]

    def rows(self, chosen: Sequence[int]) -> "Evaluation":
        """Some of the candidates."""
        index = list(chosen)
        mse, anees, diverged = (
            None if a is None else a[index] for a in (self.mse, self.anees, self.diverged)
        )
        reasons = tuple(self.reasons[i] for i in index)
        return Evaluation(self.log_likelihood[index], mse, anees, diverged, reasons)


def stacked(parts: Sequence[Evaluation]) -> Evaluation:
    """The candidates of several evaluations, one after the other."""

    def joined(name: str) -> Any:
        found = [getattr(part, name) for part in parts]
        return None if found[0] is None else np.concatenate(found)

    return Evaluation(
        joined("log_likelihood"), joined("mse"), joined("anees"), joined("diverged"),
        tuple(reason for part in parts for reason in part.reasons),
    )  # fmt: skip


class Evaluate(Protocol):
    """Computes candidates.

    Attributes:
        names: of the coordinates of the error `(coordinate,)`.
        runs: how many runs there are.
    """

    names: tuple[str, ...]
    runs: int

    def __call__(self, candidates: Sequence[Values]) -> Evaluation:
        """What the candidates give, in order."""
        ...


class Simulated:
    """Candidates of one estimator on simulated runs, whose truth is computed once and kept.

    Args:
        prepared: the experiment, built.
        label: of the estimator.
        names: what a candidate's values set.
        runs: numbers of the runs.
        workers: threads.

    Attributes:
        batches: how many sets of candidates were computed.
        candidates: how many candidates.
    """

    def __init__(
        self,
        prepared: Setup,
        label: str,
        names: Sequence[keys.Names],
        runs: Sequence[int],
        workers: int | None = None,
    ):
        only = {label: prepared.scenario.estimators[label]}
        scenario = prepared.scenario.model_copy(update={"estimators": only})
        self._base = variant(prepared, scenario)
        self._label, self._names = label, tuple(names)
        size = batch.default_batch_size(self._base, "summary")
        self._batches = [runs[i : i + size] for i in range(0, len(runs), size)]
        self._truth: list[Trajectory | None] | None = None
        self._workers = executors.worker_count(workers)
        self._stop = threading.Event()
        self.names, self.runs = prepared.space.names, len(runs)
        self.batches = self.candidates = 0

    def __call__(self, candidates: Sequence[Values]) -> Evaluation:
        """The candidates on every run; one that is refused or fails has NaN and a reason."""
        self.batches += 1
        self.candidates += len(candidates)
        made = [self._setup(values) for values in candidates]
        pool = ThreadPoolExecutor(self._workers, "estbench")
        try:
            if self._truth is None:
                self._truth = list(pool.map(lambda r: simulated(self._base, r), self._batches))
            tasks = [
                (setup, runs, truth)
                for setup in made
                for runs, truth in zip(self._batches, self._truth)
            ]
            found = list(pool.map(lambda task: self._one(*task), tasks))
        except BaseException:
            self._stop.set()
            raise
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
        per = len(self._batches)
        return stacked([self._joined(found[i * per : i * per + per]) for i in range(len(made))])

    def _setup(self, values: Values) -> Setup | str:
        """The experiment of a candidate, or why it is refused."""
        try:
            scenario = keys.changed(self._base.scenario, dict(zip(self._names, values)))
            return variant(self._base, scenario)
        except EstbenchError as error:
            return str(error)

    def _one(
        self, setup: Setup | str, runs: Sequence[int], truth: Trajectory | None
    ) -> dict[str, Array] | str:
        if isinstance(setup, str):
            return setup
        found = evaluate([setup], runs, truth, self._stop.is_set, bounded=False)
        return "interrupted" if found is None else found[0][self._label]

    def _joined(self, parts: Sequence[dict[str, Array] | str]) -> Evaluation:
        """One candidate over all runs."""
        reasons = [part for part in parts if isinstance(part, str)]
        if reasons:
            n = len(self.names)
            nothing = np.full((1, self.runs), np.nan)
            mse = np.full((1, self.runs, n), np.nan)
            return Evaluation(nothing, mse, nothing, np.ones((1, self.runs)), (reasons[0],))
        values = {
            name: np.concatenate([part[name] for part in parts if not isinstance(part, str)])[None]
            for name in ("log_likelihood", "mse", "anees", "diverged")
        }
        return Evaluation(
            values["log_likelihood"], values["mse"], values["anees"],
            values["diverged"].astype(np.float64), ("",),
        )  # fmt: skip


Progress = Callable[[int, float], None]
"""Called after each set of candidates with the count of candidates and the best loss."""
