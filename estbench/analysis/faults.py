"""Estimators that are not consistent, each in one way that is known, made from a consistent one.

Each function takes what a matched filter did and the number of runs of an experiment.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from estbench.analysis.trials import STEP, Trial, in_contact
from estbench.consistency.fields import PHASES
from estbench.consistency.verdict import Verdict
from estbench.shapes import Array, Float
from estbench.spaces.linalg import solve_lower

SMALL, LARGE = 1 / 1.9, 10.0
"""Factors on P whose inverses have the mean 1: right on average, wrong at each instant."""


def _scaled(trial: Trial, factor: Float[Array, "time _"]) -> Trial:
    """P multiplied by a factor at each instant."""
    return replace(trial, scale=trial.scale * factor)


def alternating(trial: Trial, runs: int) -> Trial:
    """P 1.9 times too small for half a second, 10 times too large for the next."""
    return _scaled(trial, np.where(trial.times // 0.5 % 2 < 1, SMALL, LARGE)[:, None])


def flickering(trial: Trial, runs: int) -> Trial:
    """The same from one instant to the next."""
    return _scaled(trial, np.where(np.arange(len(trial.times)) % 2 < 1, SMALL, LARGE)[:, None])


def drifting(trial: Trial, runs: int) -> Trial:
    """P too small at the start of a run and too large at its end, each by a factor of 1.8."""
    slope = np.linspace(-1.0, 1.0, len(trial.times))
    return _scaled(trial, 1.8 ** slope[:, None])


def prior(trial: Trial, runs: int) -> Trial:
    """P 2.5 times too small in the first tenth."""
    early = trial.times <= 0.1 * trial.times[-1]
    return _scaled(trial, np.where(early, 1 / 2.5, 1.0)[:, None])


def by_run(trial: Trial, runs: int) -> Trial:
    """P 1.9 times too small in half of the runs, 10 times too large in the others."""
    odd = np.arange(trial.error.shape[1]) % 2 < 1
    return _scaled(trial, np.where(odd, SMALL, LARGE)[None])


def hidden(trial: Trial, runs: int) -> Trial:
    """σ² of the last coordinate 1.7 times too small, of the first 3 times too large."""
    d = np.ones(trial.cov.shape[-1])
    d[-1], d[0] = np.sqrt(1 / 1.7), np.sqrt(3.0)
    return replace(trial, cov=trial.cov * np.outer(d, d))


def rotated(trial: Trial, runs: int) -> Trial:
    """The axes of P rotated by 45 degrees in the plane of the first and the last coordinate."""
    R = np.eye(trial.cov.shape[-1])
    R[0, 0] = R[-1, -1] = R[-1, 0] = np.sqrt(0.5)
    R[0, -1] = -np.sqrt(0.5)
    return replace(trial, cov=R @ trial.cov @ R.T)


def biased(trial: Trial, runs: int) -> Trial:
    """A bias of 1σ in every direction, under a doubled covariance."""
    offset = np.linalg.cholesky(trial.cov).sum(axis=-1)
    return replace(trial, error=trial.error + offset[:, None], scale=2 * trial.scale)


def common(trial: Trial, runs: int) -> Trial:
    """Half of the error's variance is the same in all runs of an experiment."""
    count = trial.error.shape[1]
    first = np.arange(count) // runs * runs
    error = np.sqrt(0.5) * (trial.error + trial.error[:, first])
    error[:, first] = trial.error[:, first]
    return replace(trial, error=error)


def channel(trial: Trial, runs: int) -> Trial:
    """The last channel's noise has 1.5 times the variance that the filter assumes."""
    factor = np.ones(trial.white.shape[-1])
    factor[-1] = np.sqrt(1.5)
    return replace(trial, white=trial.white * factor)


def restless(trial: Trial, runs: int) -> Trial:
    """S 1.9 times too small in each second tenth of a run and 10 times too large in the others.

    NIS/m is right on average, and the errors are.
    """
    odd = np.arange(len(trial.white)) // (len(trial.white) // 10) % 2
    return replace(
        trial, white=trial.white * np.sqrt(np.where(odd, 1 / LARGE, 1 / SMALL))[:, None, None]
    )


def periodic(trial: Trial, runs: int) -> Trial:
    """Innovations with a correlation of 0.3 at lag 6."""
    white = trial.white.copy()
    for k in range(6, len(white)):
        white[k] = 0.3 * white[k - 6] + np.sqrt(1 - 0.3**2) * trial.white[k]
    return replace(trial, white=white)


def coloured(trial: Trial, runs: int) -> Trial:
    """Innovations with a lag-one correlation of 0.3."""
    white = trial.white.copy()
    for k in range(1, len(white)):
        white[k] = 0.3 * white[k - 1] + np.sqrt(1 - 0.3**2) * trial.white[k]
    return replace(trial, white=white)


def lost(trial: Trial, runs: int) -> Trial:
    """One run in fifty diverged."""
    return replace(trial, lost=np.arange(len(trial.lost)) % 50 == 0)


def opposite(trial: Trial, runs: int) -> Trial:
    """σ² of the first coordinate 1.9 times too small and of the last 10 times too large, by turns.

    From one instant to the next; NEES/n, and each coordinate, are right on average.
    """
    d = np.ones(trial.cov.shape[:2])
    d[:, 0] = np.where(np.arange(len(d)) % 2, SMALL, LARGE)
    d[:, -1] = np.where(np.arange(len(d)) % 2, LARGE, SMALL)
    return replace(trial, cov=trial.cov * np.sqrt(d[:, :, None] * d[:, None, :]))


def uncorrelated(trial: Trial, runs: int) -> Trial:
    """Correlated errors (0.6) of which P has the variances only."""
    root = np.asarray(np.linalg.cholesky(trial.cov), np.float64)
    white = solve_lower(root[:, None], trial.error[..., None])[..., 0]
    n = white.shape[-1]
    mixed = white @ np.linalg.cholesky(np.full((n, n), 0.6) + 0.4 * np.eye(n)).T
    return replace(trial, error=mixed, cov=np.broadcast_to(np.eye(n), trial.cov.shape))


def landing(trial: Trial, runs: int) -> Trial:
    """P 3 times too small within 3 steps of an event of contact."""
    known = in_contact(trial)
    assert known.phases is not None
    return _scaled(known, np.where(known.phases[..., PHASES.index("event")], 1 / 3, 1.0))


def copied(trial: Trial, runs: int) -> Trial:
    """Every run is there five times."""
    source = np.arange(trial.error.shape[1]) // 5 * 5
    return replace(trial, error=trial.error[:, source], white=trial.white[:, source])


def heavy(trial: Trial, runs: int) -> Trial:
    """Errors of Student's t with 6 degrees of freedom, with the covariance that is reported."""
    rng = np.random.default_rng(len(trial.lost))
    size = np.sqrt(4 / rng.chisquare(6, trial.error.shape[1]))
    return replace(trial, error=trial.error * size[:, None])


@dataclass(frozen=True)
class Fault:
    """A fault and what it deserves.

    Attributes:
        make: the fault.
        deserved: the verdicts that are right, once the runs are enough to find it.
        named: what the reason must contain.
    """

    make: Callable[[Trial, int], Trial]
    deserved: tuple[Verdict, ...]
    named: str = ""

    @property
    def meaning(self) -> str:
        """What is wrong, in a sentence."""
        return (self.make.__doc__ or "").strip().rstrip(".")


OVER, CONSERVATIVE = (Verdict.OVERCONFIDENT,), (Verdict.CONSERVATIVE,)
FAULTS = {
    "alternating": Fault(alternating, OVER, "s"),
    "flickering": Fault(flickering, OVER, "while its covariance is small"),
    "drifting": Fault(drifting, OVER, "from 0.0"),
    "prior": Fault(prior, OVER, f"from 0.0 to {5 * STEP:.1f} s"),
    "by run": Fault(by_run, OVER, "in the runs with a small covariance"),
    "hidden": Fault(hidden, OVER, "b, 1.7 x its variance"),
    "rotated": Fault(rotated, OVER),
    "biased": Fault(biased, (Verdict.BIASED,), "σ"),
    "common": Fault(common, (*OVER, Verdict.BIASED), "σ"),
    "channel": Fault(channel, OVER, "overconfident innovations: speed, NIS/m 1.5"),
    "coloured": Fault(coloured, (Verdict.CORRELATED,), "at lag 1"),
    "restless": Fault(restless, (*OVER, *CONSERVATIVE), "innovations: NIS/m"),
    "periodic": Fault(periodic, (Verdict.CORRELATED,), "at lag 6"),
    "opposite": Fault(opposite, OVER, "x its variance while this is small"),
    "uncorrelated": Fault(uncorrelated, OVER, "in combinations of coordinates: wrong correlations"),
    "landing": Fault(landing, OVER, "within 3 steps of a touch-down or a lift-off"),
    "lost": Fault(lost, (Verdict.DIVERGING,), "runs diverged (2.0%)"),
    "copied": Fault(copied, (Verdict.UNDECIDED, Verdict.CONSISTENT), "runs are copies"),
    "heavy": Fault(heavy, (Verdict.UNDECIDED, Verdict.CONSISTENT)),
}  # fmt: skip
"""By name. Heavy tails are no fault of the covariance, and copies none of the filter."""
