"""Whole experiments on linear-Gaussian models, to calibrate the verdict: honest filters and faults.

The Kalman filter's covariance is exact there. Its errors, its covariance and its innovations are
kept as arrays, and a fault changes one of them, so that what is wrong is known by construction.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from estbench.consistency import phases, records
from estbench.consistency.fields import Record
from estbench.estimators.kf import KF
from estbench.inference.lags import Lags
from estbench.inference.traces import Traces
from estbench.models.linear import LinearModel
from estbench.scenario.schema import ConsistencySection
from estbench.shapes import Array, Bool, Float, Mask
from estbench.spaces.directions import directions
from estbench.spaces.linalg import solve_lower
from estbench.spaces.semidefinite import eigen_root

STEP = 0.1
"""s, the time of one step."""
NEAR = 3
"""Steps before and after an event of contact that belong to it."""


@dataclass(frozen=True, eq=False)
class Trial:
    """What a filter did in some runs.

    Attributes:
        error: x - x̂.
        cov: P, the same in all runs.
        scale: what the filter reports is `scale` times P.
        white: whitened innovations, one channel each.
        lost: runs that diverged.
        touching: whether the robot touches something: the first coordinate of the true state is
            negative.
        phases: of contact, in the order of `fields.PHASES`; None where the verdict is not to know.
    """

    error: Float[Array, "time run n"]
    cov: Float[Array, "time n n"]
    scale: Float[Array, "time run"]
    white: Float[Array, "time-1 run channel"]
    lost: Bool[Mask, " run"]
    touching: Bool[Mask, "time run"]
    phases: Bool[Mask, "time run phase"] | None = None

    @property
    def times(self) -> Float[Array, " time"]:
        """Of the instants, s."""
        return np.arange(len(self.error), dtype=np.float64) * STEP


def simulate(
    truth: LinearModel, runs: int, steps: int, seed: int, process_noise_scale: float = 1.0
) -> Trial:
    """A Kalman filter in many runs.

    Args:
        truth: x⁺ = A x + w, y = C x + v.
        runs: count of runs.
        steps: of each run.
        seed: of all random numbers.
        process_noise_scale: the filter's Q over the true one.
    """
    n, m = truth.A.shape[-1], truth.C.shape[0]
    filter_ = KF(replace(truth, Q=process_noise_scale * truth.Q))
    rng = np.random.default_rng(seed)
    noise, sensor = eigen_root(truth.Q)[0], np.linalg.cholesky(truth.R)
    x, u = rng.standard_normal((runs, n)), np.zeros((runs, 0))
    belief = filter_.init(np.zeros((runs, n)), np.tile(np.eye(n), (runs, 1, 1)))
    error, cov = np.empty((steps + 1, runs, n)), np.empty((steps + 1, n, n))
    white = np.empty((steps, runs, m))
    touching = np.empty((steps + 1, runs), bool)
    error[0], cov[0], touching[0] = x - belief.mean, belief.cov[0], x[:, 0] < 0
    for k in range(steps):
        x = x @ truth.A.T + rng.standard_normal((runs, n)) @ noise.T
        y = x @ truth.C.T + rng.standard_normal((runs, m)) @ sensor.T
        belief = filter_.predict(belief, u, float(k), 1.0)
        belief, innovation = filter_.update(belief, y, u, float(k + 1))
        error[k + 1], cov[k + 1], touching[k + 1] = x - belief.mean, belief.cov[0], x[:, 0] < 0
        white[k] = innovation.white
    lost = np.zeros(runs, bool)
    return Trial(error, cov, np.ones((steps + 1, runs)), white, lost, touching)


def in_contact(trial: Trial) -> Trial:
    """The same, with the phases of contact: near an event is within `NEAR` steps of a change."""
    event = np.zeros_like(trial.touching)
    event[1:] = trial.touching[1:] ^ trial.touching[:-1]
    found = phases.phases(trial.times, trial.touching, event, NEAR * STEP)
    return replace(trial, phases=found)


def traces(trial: Trial) -> Traces:
    """What the event loop records of the same runs."""
    error, (steps, runs, m) = trial.error, trial.white.shape
    root = np.asarray(np.linalg.cholesky(trial.cov), np.float64)
    whitened = solve_lower(root[:, None], error[..., None])[..., 0]
    whitened = whitened / np.sqrt(trial.scale)[..., None]
    variance = np.diagonal(trial.cov, axis1=-2, axis2=-1)[:, None] * trial.scale[..., None]
    square = trial.white**2
    channels = {str(i): 1 for i in range(m)}
    lags = Lags(runs, channels)
    for k, white in enumerate(trial.white):
        lags.put(k, 0, tuple(channels), white)
    sums, terms = lags.sums()
    return Traces(
        truth=error,
        mean=np.zeros_like(error),
        error=error,
        std=np.sqrt(variance),
        nees=np.vecdot(whitened, whitened),
        along=(whitened @ directions(error.shape[-1])) ** 2,
        rank=np.full(error.shape[:2], error.shape[-1]),
        nis=square.sum(axis=-1),
        dof=np.full((steps, runs), m),
        log_likelihood=np.zeros((steps, runs)),
        gated=np.zeros((steps, runs), np.int64),
        channel_nis=square,
        lags=sums,
        lag_terms=terms,
        fault=trial.lost.astype(np.uint8),
        fault_step=np.where(trial.lost, 1, -1),
        late=np.zeros(runs, np.int64),
        cpu_time=0.0,
    )


def reduced(trial: Trial) -> Record:
    """The numbers of each run, as they are stored."""
    section = ConsistencySection()
    return records.reduce(traces(trial), trial.times, section, "summary", trial.phases)


def experiments(record: Record, runs: int) -> Iterator[Record]:
    """Records of `runs` runs each; a remainder is not used.

    Args:
        record: of many runs.
        runs: of each experiment.
    """
    names = [name for name, field in records.SUMMARY.items() if field.dims[0] == "run"]
    for start in range(0, len(record["anees"]) // runs * runs, runs):
        yield {name: record[name][start : start + runs] for name in names}
