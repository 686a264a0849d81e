"""What a tuning minimizes: minus the log-likelihood, or a weighted mean squared error.

NEES and NIS are no objectives: with a sensor on every coordinate an infinite Q has NEES/n = 1.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from estbench.errors import StudyError
from estbench.shapes import Array, Float
from estbench.spaces.patterns import expand
from estbench.tuning.evaluation import Evaluation

Kind = Literal["likelihood", "mse", "consistent-mse"]
KINDS = ("likelihood", "mse", "consistent-mse")
MARGIN = 1.0
"""Loss of a failed run above the worst run of the start, in units of the losses' spread, plus 1."""


@dataclass(frozen=True, eq=False)
class Objective:
    """The loss of each candidate in each run; a search minimizes its mean over runs.

    `likelihood`: minus the log-likelihood of the run's readings, by the innovations (Schweppe
    1965). `mse`: Σ w_c MSE_c, with Σ w_c MSE_c = 1 at the start of the search.
    `consistent-mse`: the same under the constraint that NEES/n lies within the tolerance of 1.

    Attributes:
        kind: which.
        weights: of the coordinates' squared errors; None for the likelihood.
        failed: loss of a run that failed.
        tolerance: of NEES/n, for the constraint.
    """

    kind: Kind
    weights: Float[Array, " coordinate"] | None
    failed: float
    tolerance: float

    @classmethod
    def build(
        cls,
        kind: str,
        first: Evaluation,
        names: Sequence[str],
        chosen: dict[str, float] | None = None,
        tolerance: float = 0.05,
    ) -> "Objective":
        """The objective, scaled by what the start gave.

        Args:
            kind: one of `KINDS`.
            first: of the start, one candidate.
            names: of the coordinates.
            chosen: pattern of coordinates -> weight of their relative squared error; default all.
            tolerance: of NEES/n, for the constraint.

        Raises:
            StudyError: the kind is unknown, needs a truth that is not there, or the start failed.
        """
        if kind not in KINDS:
            raise StudyError(f"objective is {kind!r}; use one of {', '.join(KINDS)}")
        if chosen and kind == "likelihood":
            raise StudyError(
                "coordinates are chosen, which the likelihood does not know; use --objective mse"
            )
        if first.reasons[0]:
            raise StudyError(f"the estimator fails before the tuning: {first.reasons[0]}")
        weights = None
        if kind != "likelihood":
            if first.mse is None or first.anees is None:
                raise StudyError(
                    f"objective {kind!r} needs the true state, which recorded readings lack; use "
                    "likelihood"
                )
            share = np.ones(len(names)) if not chosen else expand(chosen, names, "coordinates")
            mean = np.nanmean(np.where(np.isfinite(first.mse[0]), first.mse[0], np.nan), axis=0)
            weights = share / share.sum() / np.maximum(mean, np.finfo(float).tiny)
        bare = cls(kind, weights, np.nan, tolerance)  # type: ignore[arg-type]
        losses = bare.losses(first)[0]
        finite = losses[np.isfinite(losses)]
        if not len(finite):
            raise StudyError(
                "every run fails before the tuning; start from a filter that runs, e.g. with a "
                "larger filter.process_noise_scale"
            )
        failed = float(finite.max() + MARGIN * (np.ptp(finite) + 1.0))
        return cls(bare.kind, weights, failed, tolerance)

    def losses(self, found: Evaluation) -> Float[Array, "candidate run"]:
        """The loss of each candidate in each run; that of a failed run is `failed`."""
        if self.weights is None:
            loss = -found.log_likelihood
        else:
            assert found.mse is not None
            with np.errstate(over="ignore", invalid="ignore"):
                loss = found.mse @ self.weights
        return np.where(np.isfinite(loss), loss, self.failed)

    def slack(self, found: Evaluation) -> Float[Array, "candidate 2"]:
        """How far ln(NEES/n) is inside of ± ln(1 + tolerance); negative: outside."""
        assert found.anees is not None
        anees = found.anees
        finite = np.isfinite(anees)
        total = np.where(finite, anees, 0.0).sum(axis=1)
        mean = total / np.maximum(finite.sum(axis=1), 1)
        level, room = np.log(np.maximum(mean, 1e-300)), np.log1p(self.tolerance)
        return np.stack([room - level, room + level], axis=-1)

    @property
    def constrained(self) -> bool:
        """Whether NEES/n is constrained."""
        return self.kind == "consistent-mse"
