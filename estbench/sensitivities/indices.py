"""Global sensitivity: first-order and total Sobol indices of an estimator's accuracy.

Sobol' (2001); Saltelli et al. (2010), as scipy.stats.sobol_indices computes them. All parameters
vary at the same time over their ranges; each index is a part of the variance of log y.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from estbench.errors import StudyError
from estbench.sensitivities.elasticity import size
from estbench.sensitivities.parameter import Changes, Parameter
from estbench.sensitivities.points import Outcome
from estbench.shapes import Array, Float

RESAMPLES = 200
"""Bootstrap samples of the intervals."""
OUTPUTS = ("RMSE", "NEES/n")


@dataclass(frozen=True, eq=False)
class Indices:
    """Sobol indices of log RMSE (geometric mean) and log NEES/n.

    Attributes:
        parameters: those that vary.
        ranges: text of each one's range.
        first: share of the variance by each alone `(output, parameter, 3)`: value, low, high.
        total: by each with all its interactions.
        std: standard deviation of the two outputs over the ranges.
        points: how many scenarios were computed.
    """

    parameters: tuple[Parameter, ...]
    ranges: tuple[str, ...]
    first: Float[Array, "2 p 3"]
    total: Float[Array, "2 p 3"]
    std: Float[Array, " 2"]
    points: int


def indices(
    parameters: Sequence[Parameter],
    evaluate: Callable[[Sequence[Changes]], Sequence[Outcome]],
    n: int,
    spread: float,
    seed: int,
    level: float,
) -> Indices:
    """The indices of some parameters.

    Args:
        parameters: each varies over the range that the user gives, else between value/spread and
            value·spread, uniformly on a log scale.
        evaluate: computes points.
        n: points of each of the d + 2 matrices of the method, a power of two.
        spread: a factor above 1.
        seed: of the design and the bootstrap.
        level: of the intervals, by bootstrap over the points.

    Raises:
        StudyError: n or spread is impossible, or the estimator fails at a point.
    """
    check(n, spread, len(parameters))
    calls: list[Array] = []

    def of(shares: Array) -> Array:
        points = [_point(parameters, column, spread) for column in shares.T.tolist()]
        calls.append(np.array([_logs(o) for o in evaluate(points)]).T)
        return calls[-1].copy()

    rng = np.random.default_rng(seed)
    uniform = stats.uniform()
    found = stats.sobol_indices(func=of, n=n, dists=[uniform] * len(parameters), rng=rng)
    A, B, AB = calls[0], calls[1], np.moveaxis(calls[2].reshape(2, n, -1), -1, 0)
    samples = []
    for _ in range(RESAMPLES):
        i = rng.integers(n, size=n)
        own = {"f_A": A[:, i], "f_B": B[:, i], "f_AB": AB[:, :, i]}
        again = _of_values(own, n)
        samples.append(again)
    tails = [50 * (1 - level), 50 * (1 + level)]
    ends = np.percentile(np.array(samples), tails, axis=0)
    shape = (2, len(parameters))
    first, total = (
        np.stack([np.reshape(value, shape), ends[0, k], ends[1, k]], axis=-1)
        for k, value in enumerate((found.first_order, found.total_order))
    )
    std = np.concatenate([A, B], axis=1).std(axis=1)
    texts = tuple(_range(p, spread) for p in parameters)
    return Indices(tuple(parameters), texts, first, total, std, n * (len(parameters) + 2))


def check(n: int, spread: float, count: int) -> None:
    """Whether the indices can be computed, before anything is.

    Raises:
        StudyError: they cannot.
    """
    if n < 2 or n & (n - 1):
        raise StudyError(f"--sobol is {n}; use a power of two, e.g. 64")
    if not spread > 1:
        raise StudyError(f"--spread is {spread:g}; use a factor above 1, e.g. 2")
    if count < 2:
        raise StudyError("--sobol needs at least two parameters; name more with --key")


def _of_values(values: dict[str, Array], n: int) -> Array:
    """First-order and total indices (2, output, parameter) of known outputs."""
    found = stats.sobol_indices(func=values, n=n)
    shape = (2, len(values["f_AB"]))
    return np.stack([np.reshape(x, shape) for x in (found.first_order, found.total_order)])


def _point(parameters: Sequence[Parameter], shares: Sequence[float], spread: float) -> Changes:
    out: dict = {}
    for p, share in zip(parameters, shares):
        if p.given is not None:
            out |= p.at(share)
        else:
            out |= p.changes(p.possible(spread ** (2 * share - 1)))
    return out


def _logs(outcome: Outcome) -> tuple[float, float]:
    """Logarithms of RMSE and NEES/n.

    Raises:
        StudyError: there is none.
    """
    if outcome.record is None:
        raise StudyError(f"a point of the study fails: {outcome.reason}; narrow the ranges")
    rmse, nees = size(outcome.record)
    if not (rmse > 0 and nees > 0):
        raise StudyError(
            f"a point of the study has the RMSE {rmse:g} and NEES/n {nees:g}, which have no "
            "logarithm: every run diverged, or nothing is unknown; narrow the ranges"
        )
    return float(np.log(rmse)), float(np.log(nees))


def _range(p: Parameter, spread: float) -> str:
    if p.given is not None:
        return f"{p.given.low:g} to {p.given.high:g} {p.unit}".rstrip()
    low, high = (p.shown(p.possible(factor)) for factor in (1 / spread, spread))
    return f"{low.removesuffix(p.unit).rstrip()} to {high}"
