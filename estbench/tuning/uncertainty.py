"""How well the data determine tuned values: standard errors, correlations, flat directions."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estbench.consistency.intervals import Interval, normal_quantile
from estbench.shapes import Array, Bool, Float, Mask
from estbench.tuning.parameters import Parameter
from estbench.tuning.problem import Problem
from estbench.tuning.search import CURVATURE_STEP, curvature

FLAT = float(np.log(10.0)) / 2
"""Standard deviation of a log value above which a direction is flat: ± 2 of it are a factor of
100."""
PART = 0.25
"""Share of a unit direction above which a parameter belongs to it."""


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Of the coordinates of the search, which are logarithms of most values.

    Attributes:
        std: standard errors; infinite for a value that the data do not determine, NaN at an end of
            the range.
        correlation: of the estimates; NaN where there is no standard error.
        robust: standard errors without the assumption that the model is right, from the spread of
            the runs' slopes (the sandwich of Huber 1967 and White 1982).
        at_end: which values stand at an end of their range.
        flat: directions that the data do not determine, unit vectors.
    """

    std: Float[Array, " p"]
    correlation: Float[Array, "p p"]
    robust: Float[Array, " p"]
    at_end: Bool[Mask, " p"]
    flat: Float[Array, "k p"]


def uncertainty(problem: Problem, point: Float[Array, " p"]) -> Uncertainty:
    """From the curvature of the loss at its minimum.

    For the likelihood the covariance is H⁻¹, H the second derivatives of minus the log-likelihood
    of all runs (observed information). For a squared error, and as `robust`, it is H⁻¹ G H⁻¹ with
    G = Σ s sᵀ over the runs, s the slopes of one run's loss.

    Args:
        problem: after the search.
        point: the best point.
    """
    low, high = problem.bounds.T
    mean, scores = curvature(problem, point)
    runs = scores.shape[1]
    h = np.minimum(CURVATURE_STEP, 0.25 * (high - low))
    at_end = (point < low + h / 2) | (point > high - h / 2)
    inner = np.flatnonzero(~at_end)
    H = runs * mean[np.ix_(inner, inner)]
    centred = scores[inner] - scores[inner].mean(axis=1, keepdims=True)
    G = centred @ centred.T
    values, vectors = np.linalg.eigh(H)
    weak = values < 1.0 / FLAT**2
    firm = vectors[:, ~weak]
    inverse = firm @ np.diag(1.0 / values[~weak]) @ firm.T
    sandwich = inverse @ G @ inverse
    cov = inverse if problem.objective.kind == "likelihood" else sandwich
    p = len(point)
    undetermined = (np.abs(vectors[:, weak]) > PART).any(axis=1)
    std, robust = np.full(p, np.nan), np.full(p, np.nan)
    for out, found in ((std, cov), (robust, sandwich)):
        with np.errstate(invalid="ignore"):
            out[inner] = np.where(undetermined, np.inf, np.sqrt(np.diag(found)))
    correlation = np.full((p, p), np.nan)
    size = np.sqrt(np.diag(cov))
    with np.errstate(divide="ignore", invalid="ignore"):
        part = np.where(undetermined, np.nan, cov / size / size[:, None])
    correlation[np.ix_(inner, inner)] = np.where(undetermined[:, None], np.nan, part)
    flat = np.zeros((int(weak.sum()), p))
    flat[:, inner] = vectors[:, weak].T
    return Uncertainty(std, correlation, robust, at_end, flat)


def interval(parameter: Parameter, coordinate: float, std: float, level: float) -> Interval:
    """The value with its interval, symmetric in the coordinate of the search."""
    value = parameter.value(coordinate)
    if not np.isfinite(std):
        return Interval(value, -np.inf, np.inf)
    half = normal_quantile(level) * std
    if parameter.log:
        return Interval(value, value * float(np.exp(-half)), value * float(np.exp(half)))
    half *= parameter.high - parameter.low
    return Interval(value, value - half, value + half)


def in_words(parameters: Sequence[Parameter], found: Uncertainty) -> list[str]:
    """One sentence per flat direction, per value at an end, and per strong correlation."""
    out = []
    for direction in found.flat:
        part = [i for i in np.argsort(-np.abs(direction)) if abs(direction[i]) > PART]
        if len(part) == 1:
            out.append(f"the data do not determine {parameters[part[0]].key}")
            continue
        sign = np.sign(direction[part[0]])
        ways = [f"{parameters[i].key} {'up' if sign * direction[i] > 0 else 'down'}" for i in part]
        out.append(
            f"the data do not determine {', '.join(ways)} together: only what this leaves unchanged"
        )
    for parameter, ended in zip(parameters, found.at_end):
        if ended:
            out.append(
                f"{parameter.key} is at an end of its range, {parameter.low:g} to "
                f"{parameter.high:g}; widen it, or fix the parameter"
            )
    strong = np.argwhere(np.triu(np.abs(np.nan_to_num(found.correlation)), 1) > 0.9)
    for i, j in strong:
        out.append(
            f"{parameters[i].key} and {parameters[j].key} are correlated, "
            f"{found.correlation[i, j]:+.2f}: the data determine them together better than each"
        )
    return out


@dataclass(frozen=True, eq=False)
class Profile:
    """The loss along one parameter, the others moved to where the curvature puts their optimum.

    Attributes:
        values: of the parameter.
        loss: of all runs above the least one.
        expected: the paraboloid of the curvature.
    """

    values: Float[Array, " k"]
    loss: Float[Array, " k"]
    expected: Float[Array, " k"]


def profiles(
    problem: Problem, point: Float[Array, " p"], found: Uncertainty, count: int = 9
) -> tuple[Profile, ...]:
    """Profiles of all parameters over ± 3 standard errors, at most their ranges, as one set.

    The others move along the regression of the estimates, ρ σᵢ/σⱼ, which is the profile to second
    order.
    """
    low, high = problem.bounds.T
    paths = []
    for j in range(len(point)):
        std = found.std[j]
        reach = 3 * std if np.isfinite(std) else 0.5 * (high[j] - low[j])
        offsets = reach * np.linspace(-1, 1, count)
        rho = np.nan_to_num(found.correlation[:, j])
        with np.errstate(invalid="ignore", divide="ignore"):
            along = np.nan_to_num(rho * found.std / std, posinf=0.0, neginf=0.0)
        along[j] = 1.0
        paths.append(np.clip(point + offsets[:, None] * along, low, high))
    _, loss = problem.at(np.concatenate(paths))
    _, (least,) = problem.at(point[None])
    runs, out = problem.evaluate.runs, []
    for j, (path, own) in enumerate(zip(paths, loss.reshape(len(point), count))):
        parameter = problem.parameters[j]
        values = np.array([parameter.value(x) for x in path[:, j]])
        with np.errstate(invalid="ignore", divide="ignore"):
            expected = 0.5 * ((path[:, j] - point[j]) / found.std[j]) ** 2
        out.append(Profile(values, runs * (own - least), expected))
    return tuple(out)
