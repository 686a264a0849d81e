"""The searches: quasi-Newton with slopes, Nelder-Mead and differential evolution without."""

import numpy as np
from scipy import optimize

from estbench.errors import StudyError
from estbench.shapes import Array, Float
from estbench.tuning.evaluation import Evaluation
from estbench.tuning.problem import STEP, Problem, neighbours

METHODS = ("auto", "quasi-newton", "nelder-mead", "evolution", "optuna")
NEWTON_STEPS = 6
"""Most Newton steps at the end of the quasi-Newton search."""
RESTARTS = 4
"""How often the quasi-Newton search begins anew from the best point while that lowers the loss: a
line search among failed candidates may end it early."""
NEGLIGIBLE = 3e-4
"""Length of the last Newton step, in standard errors of the estimate."""
CURVATURE_STEP = 0.02
"""Distance of the candidates of a second difference, in the coordinate of the search."""


def run(problem: Problem, method: str, seed: int, most: int) -> None:
    """Search; the result is `problem.best`.

    Args:
        problem: what is minimized.
        method: one of `METHODS`; `auto` takes the fitting one.
        seed: of the evolution and of optuna.
        most: iterations (quasi-Newton, evolution) or candidates (Nelder-Mead, optuna).

    Raises:
        StudyError: the method is unknown, or does not fit the parameters.
    """
    kinds = {p.kind for p in problem.parameters}
    if method not in METHODS:
        raise StudyError(f"method is {method!r}; use one of {', '.join(METHODS)}")
    if method == "auto":
        method = chosen(kinds, problem.objective.constrained)
    if kinds & {"choice"} and method != "optuna":
        raise StudyError(f"a choice between values is free, which {method} cannot search; "
                         "use --method optuna")  # fmt: skip
    if method == "optuna":
        from estbench.tuning import choices  # an extra, slow to import

        choices.search(problem, seed, most)
    elif method == "quasi-newton":
        quasi_newton(problem, most)
    elif problem.objective.constrained:
        raise StudyError(f"the objective has a constraint, which {method} does not know; use "
                         "--method quasi-newton")  # fmt: skip
    elif method == "nelder-mead":
        nelder_mead(problem, most)
    else:
        evolution(problem, seed, most)


def chosen(kinds: set[str], constrained: bool = False) -> str:
    """The method that `auto` means."""
    if "choice" in kinds:
        return "optuna"
    return "quasi-newton" if kinds == {"smooth"} or constrained else "evolution"


def quasi_newton(problem: Problem, most: int) -> None:
    """BFGS on the coordinates of the search, each slope from the same set of candidates.

    L-BFGS-B, with a constraint SLSQP; then Newton steps with the curvature from second
    differences. A candidate that fails is replaced by a paraboloid about the best one, which leads
    the line search back.
    """
    known: dict[bytes, tuple[float, Array, Array, Array]] = {}

    def look(point: Array) -> tuple[float, Array, Array, Array]:
        """Loss, slope, slack of the constraint and its slope."""
        if point.tobytes() not in known:
            found, loss, width, scores = problem.slopes(point)
            problem.visited(point, float(loss[0]))
            known[point.tobytes()] = _guarded(problem, point, found, loss, width, scores)
        return known[point.tobytes()]

    low, high = problem.bounds.T
    start = np.clip(problem.start, low, high)
    bounds = optimize.Bounds(low, high)
    if problem.objective.constrained:
        inside = {
            "type": "ineq", "fun": lambda x: look(x)[2], "jac": lambda x: look(x)[3],
        }  # fmt: skip
        optimize.minimize(
            lambda x: look(x)[:2], start, jac=True, bounds=bounds, constraints=[inside],
            method="SLSQP", options={"maxiter": most, "ftol": 1e-8},
        )  # fmt: skip
        return
    for _ in range(RESTARTS):
        before = problem.best[1]
        optimize.minimize(
            lambda x: look(x)[:2], start, jac=True, bounds=bounds, method="L-BFGS-B",
            options={"maxiter": most, "maxls": 12, "ftol": 1e-9, "gtol": 1e-4},
        )  # fmt: skip
        best, least = problem.best
        if best is None or not least < before - 1e-6 * abs(least):
            break
        start = best
    _newton(problem)


def _guarded(
    problem: Problem, point: Array, found: Evaluation, loss: Array, width: Array, scores: Array
) -> tuple[float, Array, Array, Array]:
    p = len(point)
    slope = (loss[1 + p :] - loss[1 : 1 + p]) / width
    slack, steep = np.zeros(2), np.zeros((2, p))
    if problem.objective.constrained:
        slacks = problem.objective.slack(found)
        slack, steep = slacks[0], (slacks[1 + p :] - slacks[1 : 1 + p]).T / width
    best, least = problem.best
    if any(found.reasons) and best is not None:
        away = point - best
        return least + abs(least) + 1e3 * float(away @ away), 2e3 * away, slack, steep
    return float(loss[0]), slope, slack, steep


def _newton(problem: Problem) -> None:
    """Newton steps from the best point, each from one set of candidates, while they lower it."""
    low, high = problem.bounds.T
    point = problem.best[0]
    if point is None:
        return
    least = np.inf
    for _ in range(NEWTON_STEPS + 1):
        found, loss, slope, hessian = _expansion(problem, point)
        problem.visited(point, loss)
        if any(found.reasons) or loss > least + 1e-12 * abs(least):
            return
        problem.best, least = (point, loss), loss
        free = ((point > low) | (slope < 0)) & ((point < high) | (slope > 0))
        values, vectors = np.linalg.eigh(hessian[np.ix_(free, free)])
        firm = values > 1e-6 * max(values.max(initial=0.0), 1e-12)
        along = vectors[:, firm]
        step = np.zeros(len(point))
        step[free] = -along @ ((along.T @ slope[free]) / values[firm])
        step *= min(1.0, 1.0 / max(np.abs(step).max(initial=0.0), 1e-300))
        ahead = np.clip(point + step, low, high)
        decrement = np.sqrt(max(problem.evaluate.runs * float(step @ hessian @ step), 0.0))
        if decrement < NEGLIGIBLE:  # the error that is left is of the order of its square
            _, last = problem.at(ahead[None])
            if last[0] <= loss + 1e-12 * abs(loss):
                problem.best = ahead, float(last[0])
            return
        point = ahead


def _expansion(
    problem: Problem, point: Float[Array, " p"]
) -> tuple[Evaluation, float, Float[Array, " p"], Float[Array, "p p"]]:
    """Loss, slope and curvature at a point, from one set of candidates."""
    near, width = neighbours(point, problem.bounds, STEP)
    far, h = _second(problem, point)
    found, loss = problem.at(np.concatenate([near, far]))
    p = len(point)
    slope = (loss[1 + p : 1 + 2 * p] - loss[1 : 1 + p]) / width
    return found, float(loss[0]), slope, _hessian(loss[len(near) :], h)


def curvature(
    problem: Problem, point: Float[Array, " p"]
) -> tuple[Float[Array, "p p"], Float[Array, "p run"]]:
    """Second differences of the mean loss, and the slopes of each run's loss.

    From one set of 1 + 2 p + p (p - 1) candidates.
    """
    points, h = _second(problem, point)
    found, loss = problem.at(points)
    losses, p = problem.objective.losses(found), len(point)
    scores = (losses[1 + p : 1 + 2 * p] - losses[1 : 1 + p]) / (2 * h[:, None])
    return _hessian(loss, h), scores


def _second(
    problem: Problem, point: Float[Array, " p"]
) -> tuple[Float[Array, "k p"], Float[Array, " p"]]:
    """The candidates of second differences about a point, and their distances.

    A point near the end of its range is moved inside by the distance.
    """
    low, high = problem.bounds.T
    h = np.minimum(CURVATURE_STEP, 0.25 * (high - low))
    point = np.clip(point, low + h, high - h)
    e = h * np.eye(len(point))
    first, second = np.triu_indices(len(point), 1)
    both = e[first] + e[second]
    return np.concatenate([point[None], point - e, point + e, point - both, point + both]), h


def _hessian(loss: Float[Array, " k"], h: Float[Array, " p"]) -> Float[Array, "p p"]:
    """Second differences from the losses at the points of `_second`."""
    p = len(h)
    first, second = np.triu_indices(p, 1)
    middle, below, above = loss[0], loss[1 : 1 + p], loss[1 + p : 1 + 2 * p]
    out = np.diag((below - 2 * middle + above) / h**2)
    down, up = loss[1 + 2 * p : 1 + 2 * p + len(first)], loss[1 + 2 * p + len(first) :]
    lone = below[first] + above[first] + below[second] + above[second]
    cross = (up + down - lone + 2 * middle) / (2 * h[first] * h[second])
    out[first, second] = out[second, first] = cross
    return out


def nelder_mead(problem: Problem, most: int) -> None:
    """The simplex search, for losses with kinks in few parameters."""

    def loss(point: Array) -> float:
        value = float(problem.at(point[None])[1][0])
        problem.visited(point, value)
        return value

    low, high = problem.bounds.T
    start = np.clip(problem.start, low, high)
    corners = np.concatenate([start[None], start + 0.2 * (high - low) * np.eye(len(start))])
    corners = np.where(corners > high, 2 * start - corners, corners)
    optimize.minimize(
        loss, start, bounds=optimize.Bounds(low, high), method="Nelder-Mead",
        options={"maxfev": most, "initial_simplex": corners, "xatol": 1e-3, "fatol": 1e-6},
    )  # fmt: skip


def evolution(problem: Problem, seed: int, most: int) -> None:
    """Differential evolution, each generation computed as one set of candidates."""

    def loss(points: Array) -> Array:
        values = problem.at(np.atleast_2d(points.T))[1]
        best, least = problem.best
        if best is not None:
            problem.visited(best, least)
        return values

    low, high = problem.bounds.T
    optimize.differential_evolution(
        loss, optimize.Bounds(low, high), maxiter=most, popsize=8, tol=1e-3, rng=seed,
        x0=np.clip(problem.start, low, high), vectorized=True, updating="deferred", polish=False,
        init="sobol",
    )  # fmt: skip
