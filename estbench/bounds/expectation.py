"""The posterior Cramér-Rao bound of a model, by expectation over true runs."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from estbench.bounds import recursion
from estbench.bounds.linearization import Linearization, Linearized
from estbench.bounds.recursion import Step
from estbench.errors import DimensionError, shown
from estbench.inference.priors import checked_prior, real
from estbench.models.protocol import Model
from estbench.shapes import Array, Bool, Float, Mask
from estbench.spaces.linalg import quiet, solve_lower
from estbench.spaces.semidefinite import psd_root


@dataclass(frozen=True, eq=False)
class Reading:
    """Some channels, read at one time.

    Attributes:
        taken: index of the time at which they are read, at least 1.
        arrives: index of the time from which on they count.
        channels: their names; None is all.
        mask: the runs in which the reading arrives then `(run,)`; None is all.
    """

    taken: int
    arrives: int
    channels: tuple[str, ...] | None = None
    mask: Bool[Mask, " run"] | None = None


@dataclass(frozen=True, eq=False)
class Bound:
    """A lower bound on the mean square error of every estimator, time by time.

    Attributes:
        cov: on E[e eᵀ], e = x ⊖ x̂, (unit)². NaN from where no run has finite Jacobians.
        values: numbers of each run whose mean is the diagonal of `cov`: their spread gives the
            error of the expectation over the runs. NaN for a run with states that are not finite.
    """

    cov: Float[Array, "time n n"]
    values: Float[Array, "time run n"]


def posterior_bound(
    model: Model,
    mean: Float[Array, " nx"],
    cov: Float[Array, "n n"],
    times: Float[Array, " time"],
    x: Float[Array, "time run nx"],
    u: Float[Array, "time-1 run nu"] | None = None,
    readings: Sequence[Reading] | None = None,
) -> Bound:
    """The posterior Cramér-Rao bound of a filter (see `bounds.recursion`).

    At each time it is the bound given the readings that have arrived by then.

    Args:
        model: of the truth.
        mean: of x₀, which is normal.
        cov: of x₀, (unit)²; it may be singular.
        times: s, increasing.
        x: true states of many runs, drawn from the model; the expectation is over them.
        u: controls, held from each time to the next; default none.
        readings: default all channels at every time but the first.

    Raises:
        DimensionError: an array is none of real numbers or does not fit the others, times fall, or
            a reading is not within them.
        CovarianceError: P₀ is not symmetric positive semidefinite.
    """
    space = model.space
    times = real("times is", times, "(time,)")
    x = real("x is", x, "(time, run, nx)")
    u = None if u is None else real("u is", u, "(time - 1, run, nu)")
    mean = real("mean is", mean, "x̂₀ of shape (nx,)")
    cov = real("cov is", cov, "P₀ of shape (n, n)")
    if mean.ndim != 1 or cov.ndim != 2:
        raise DimensionError(
            f"mean has shape {mean.shape} and cov {cov.shape}; expected (nx,) and (n, n)"
        )
    checked_prior(mean[None], cov[None], space)
    if times.ndim != 1 or (np.diff(times) < 0).any() or not np.isfinite(times).all():
        raise DimensionError(f"times is {shown(times)}; expected rising numbers (time,)")
    if x.ndim != 3 or x.shape[::2] != (len(times), space.nx):
        raise DimensionError(
            f"x has shape {x.shape}; expected ({len(times)}, run, {space.nx}): true states of "
            "every time and run"
        )
    u = np.zeros((len(times) - 1, x.shape[1], model.nu)) if u is None else u
    if u.shape != (len(times) - 1, x.shape[1], model.nu):
        raise DimensionError(
            f"u has shape {u.shape}; expected {(len(times) - 1, x.shape[1], model.nu)}"
        )
    if readings is None:
        readings = [Reading(k, k) for k in range(1, len(times))]
    for r in readings:
        if not 1 <= r.taken <= r.arrives < len(times):
            raise DimensionError(
                f"readings: one is taken at time {r.taken} and arrives at {r.arrives}; use "
                f"1 <= taken <= arrives <= {len(times) - 1}"
            )
    start = psd_root(cov), space.reset_jacobian(space.minus(x[0], mean))
    path = list(follow(start, Linearization(model), times, x, u, readings))
    return Bound(np.stack([v.bound() for v in path]), np.stack([v.values() for v in path]))


def follow(
    start: tuple[Float[Array, "k k"], Float[Array, "run k k"]],
    system: Linearized,
    times: Sequence[float] | Float[Array, " time"],
    x: Float[Array, "time run nx"],
    u: Float[Array, "time-1 run nu"],
    readings: Sequence[Reading],
) -> Iterator[recursion.Variations]:
    """The variations at each time, one after the other.

    Args:
        start: the arguments of `recursion.start`.
        system: linearized at the truth.
        times: s.
        x: true states.
        u: controls.
        readings: in any order.
    """
    taken: list[dict[tuple[str, ...] | None, int]] = [{} for _ in times]  # channels -> last arrival
    arriving: list[list[Reading]] = [[] for _ in times]
    for r in readings:
        last = taken[r.taken].get(r.channels, 0)
        taken[r.taken][r.channels] = max(last, r.arrives)
        arriving[r.arrives].append(r)
    waiting: dict[recursion.Key, int] = {}
    now = recursion.start(*start, each=any(r.mask is not None for r in readings))
    yield now
    with quiet():
        for k in range(1, len(times)):
            t, end = float(times[k - 1]), float(times[k])
            F, G = system.transition(x[k - 1], x[k], u[k - 1], t, end - t)
            waiting |= {(k, channels): last for channels, last in taken[k].items()}
            waiting = {key: last for key, last in waiting.items() if last >= k}
            arrived = [((r.taken, r.channels), r.mask) for r in arriving[k]]
            seen = whitened(system, k, list(taken[k]), x[k], u[k - 1], end)
            later = {key for key, last in waiting.items() if last > k}
            now = recursion.step(now, Step(F, G, seen, arrived, later))
            yield now


def whitened(
    system: Linearized,
    k: int,
    groups: Sequence[tuple[str, ...] | None],
    x: Float[Array, "run nx"],
    u: Float[Array, "run nu"],
    t: float,
) -> dict[recursion.Key, Float[Array, "run m n"]]:
    """R^(-1/2) H of the readings that are taken at the k-th time, all in one evaluation."""
    if not groups:
        return {}
    names = None if None in groups else tuple(name for group in groups if group for name in group)
    _, H, R = system.measurement(x, u, t, names)
    white = solve_lower(np.asarray(np.linalg.cholesky(R), np.float64), H)
    if names is None:
        return {(k, None): white}
    out: dict[recursion.Key, Array] = {}
    first = 0
    for group in groups:
        stop = first + system.output(group).n
        out[k, group] = white[:, first:stop]
        first = stop
    return out
