"""The recursion of the posterior Cramér-Rao bound, in a form that takes singular Q.

The unknowns are x₀ and the white noises w₀, w₁, ... of all steps, each N(0, I). A *variation* is a
small change a of these unknowns. The change aₖ of wₖ may depend on x₀, w₀, ..., wₖ₋₁ and not on
what comes later. It changes the states by ξₖ₊₁ = Fₖ ξₖ + Gₖ aₖ. For the columns of several such
variations and every estimator x̂ₖ of the readings that have arrived, the covariance inequality gives

    E[(x̂ₖ - xₖ)(x̂ₖ - xₖ)ᵀ] ≥ V W⁻¹ Vᵀ,   V = E[ξₖ],
    W = E[a₀ᵀ P₀⁻¹ a₀ + Σ aⱼᵀ aⱼ + Σ ξⱼᵀ Hⱼᵀ Rⱼ⁻¹ Hⱼ ξⱼ],

the last sum over the readings that have arrived by k, each at the time j at which it was taken
(Weinstein & Weiss 1988, IEEE Trans. IT 34(2), eq. 17, with the score of the joint density along
the variations). No inverse of Q is needed. Each step begins with the variations of the last one and
one new variation for each component of w, and keeps a few linear combinations of them
(`bounds.combination`), so that its cost does not grow. The combinations are such that

    V W⁻¹ Vᵀ = T Tᵀ,   W of the combinations = I,   V of the combinations = T.

Where F, G and H are constants this is the Kalman filter's covariance in square-root form.

Tichavský, Muravchik & Nehorai (1998, IEEE Trans. SP 46(5)) vary one state xₖ alone: wₖ₋₁ makes the
change and aₖ = -Gₖ⁻¹ Fₖ ξₖ takes it back, for which G must be regular. Where it is, `step` adds
these variations to those that go on. Their recursion is the one that keeps no others.

Which readings arrive may be random (dropout, jitter, random latency). An estimator knows it, and so
may the combinations: each run has its own. Then V = E[ξ Tᵀ] and W = E[T W Tᵀ], so that the bound is
the mean of those given what arrives, not that of mean information, which is lower.
"""

from collections.abc import Hashable, Mapping, Sequence, Set
from dataclasses import dataclass, field

import numpy as np

from estbench.bounds.combination import best, best_of_each
from estbench.shapes import Array, Bool, Float, Mask
from estbench.spaces.linalg import solve_one_lower, surely_finite
from estbench.spaces.semidefinite import psd_root

Key = Hashable
"""Names one reading: its channel, and the instant at which it was taken."""
Seen = Mapping[Key, Float[Array, "run m _"]]
"""Reading -> R^(-1/2) H ξ of the time at which it was taken."""
REGULAR = 1e-7
"""A noise whose factor has a smaller reciprocal condition number leaves a coordinate out."""
ROUNDING = 1e-18
"""A mean square difference between runs, relative to the mean square, that is of rounding."""
FLOOR = 1e-12
"""Of the mean square of a variation, added to W: it keeps W regular and the bound below."""


@dataclass(frozen=True, eq=False)
class Step:
    """One interval and its end, linearized at the true states.

    Attributes:
        F: of the transition.
        G: change of the state at the end by a unit of each white noise; one, or one per run.
        taken: readings that are taken at the end, as R^(-1/2) H.
        arrived: readings that arrive at the end, taken then or before, and the runs in which they
            do; None is all.
        waiting: readings of which some are still on their way.
    """

    F: Float[Array, "run n n"]
    G: Float[Array, "... n k"]
    taken: Mapping[Key, Float[Array, "run m n"]] = field(default_factory=dict)
    arrived: Sequence[tuple[Key, Bool[Mask, " run"] | None]] = ()
    waiting: Set[Key] = frozenset()


@dataclass(frozen=True, eq=False)
class Variations:
    """The variations that are kept, at one time.

    Attributes:
        xi: ξ of each run that counts, one column for each variation.
        cost: what each of these runs adds to W.
        factor: T; one, or one per run given what has arrived in it.
        waiting: readings on their way.
        expected: the same for a run with the mean Jacobians; None where all runs have one T.
        counts: the runs whose states and Jacobians have been finite so far `(run,)`.
    """

    xi: Float[Array, "run n k"]
    cost: Float[Array, "run k k"]
    factor: Float[Array, "... n k"]
    waiting: Seen
    expected: Seen | None
    counts: Mask

    def bound(self) -> Float[Array, "n n"]:
        """The bound on the mean square error matrix, V W⁻¹ Vᵀ."""
        if self.expected is None:
            return self.factor @ self.factor.T
        V = _mean(self.xi @ self.factor.mT)
        return V @ self._weights()

    def values(self) -> Float[Array, "_ n"]:
        """One number per run and coordinate, whose mean over the runs is the bound's diagonal.

        That of ξ Tᵀ + T ξᵀ - T W Tᵀ. The combinations are the best ones, so that to first order the
        bound depends on the runs through this mean only, and its standard error is that of a mean.
        NaN for a run that does not count.
        """
        T, out = self.factor, np.full((len(self.counts), self.xi.shape[1]), np.nan)
        if not self.counts.any():
            return out
        if self.expected is not None:
            T = self._weights().T @ T
        out[self.counts] = ((2.0 * self.xi - T @ self.cost) * T).sum(axis=-1)
        return out

    def _weights(self) -> Float[Array, "n n"]:
        """W⁻¹ Vᵀ of the combinations ξ Tᵀ; about the identity."""
        T = self.factor
        V, W = _mean(self.xi @ T.mT), _mean(T @ self.cost @ T.mT)
        size = np.sqrt(np.diag(W))
        size = np.where(size > 0, size, 1.0)
        scaled = np.linalg.pinv(W / np.outer(size, size), rcond=FLOOR, hermitian=True)
        return (scaled / np.outer(size, size)) @ V.T


def start(
    factor: Float[Array, "n n"], jacobian: Float[Array, "run n n"], each: bool = False
) -> Variations:
    """The variations of x₀ alone.

    Args:
        factor: a square root of P₀.
        jacobian: from a change of x₀ in the tangent at the prior mean to that in the tangent at x₀.
        each: whether each run is to have its own combinations, as what arrives in it is random.
    """
    counts = np.asarray(np.isfinite(jacobian).all(axis=(-2, -1)))
    xi = jacobian[counts] @ factor
    cost = np.broadcast_to(np.eye(len(factor)), xi.shape)
    T = _mean(xi)
    return Variations(xi, cost, T[None].repeat(len(xi), 0) if each else T, {}, {} if each else None,
                      counts)  # fmt: skip


def step(before: Variations, now: Step) -> Variations:
    """The variations at the end of an interval, with the readings that have arrived by then.

    No run counts any more when a matrix of this step has no decomposition: its numbers lie too far
    apart for float64.

    Args:
        before: those at its start.
        now: the interval, linearized.
    """
    before, now = _counted(before, now)
    if not before.counts.any():
        return before
    try:
        return _next(before, now)
    except np.linalg.LinAlgError:
        return _of_runs(before, np.zeros_like(before.counts))


def _next(before: Variations, now: Step) -> Variations:
    """The variations at the end of an interval; all numbers so far are finite."""
    kept, moved = before.xi.shape[-1], now.F @ before.xi
    mean = _mean(moved) if before.expected is None else _mean(now.F) @ before.factor
    steered = _steering(_mean(mean) if mean.ndim == 3 else mean, now.G) @ (mean - moved)
    moved, noises = moved + now.G @ steered, [steered]
    back = _regular_inverse(now.G) if before.expected is None else None
    if back is not None:
        noises.append(_centred(back @ moved))
    fresh = np.eye(now.G.shape[-1])
    noises.append(np.broadcast_to(fresh, (*moved.shape[:-2], *fresh.shape)))
    change = np.concatenate(noises, axis=-1)  # a of all variations
    xi = np.concatenate([moved, now.G @ change[..., kept:]], axis=-1)
    seen = {**before.waiting, **{key: H @ xi for key, H in now.taken.items()}}
    if before.expected is None:
        W = _weight(before.cost, change, seen, now.arrived, back is not None)
        later = [_mean(M) for key, M in seen.items() if key in now.waiting]
        (mix, factor), expected = best(W, _mean(xi), later), None
    else:
        mix, factor, expected = _expected(before, now)
    first, driven = mix[..., :kept, :], change @ mix
    cost = first.mT @ before.cost @ first + driven.mT @ driven
    mixed = {key: M @ mix[..., : M.shape[-1], :] for key, M in seen.items()}
    for key, here in now.arrived:
        cost = cost + _squares(mixed[key], here)
    waiting = {key: M for key, M in mixed.items() if key in now.waiting}
    return Variations(xi @ mix, cost, factor, waiting, expected, before.counts)


def _weight(
    cost: Float[Array, "run n n"],
    change: Float[Array, "run k _"],
    seen: Seen,
    arrived: Sequence[tuple[Key, Bool[Mask, " run"] | None]],
    regular: bool,
) -> Float[Array, "_ _"]:
    """W of all variations together: those that go on, those that are taken back, the new ones.

    Args:
        cost: of those that go on, so far.
        change: a of this interval.
        seen: readings.
        arrived: those that arrive.
        regular: whether there are variations that are taken back. A small number is added to
            their weight, as they may all be 0.
    """
    runs, kept = len(cost), cost.shape[-1]
    W = _gram(change) / runs
    W[:kept, :kept] += _mean(cost)
    if regular:
        size = np.diag(W)[kept : 2 * kept]
        place = np.arange(kept, 2 * kept)
        W[place, place] += np.where(size > 0, FLOOR * size, 1.0)
    for key, here in arrived:
        M = seen[key] if here is None else seen[key][here]
        W[: M.shape[-1], : M.shape[-1]] += _gram(M) / runs
    return W


def _gram(M: Float[Array, "run m k"]) -> Float[Array, "k k"]:
    """Σ MᵀM over the runs: one product of flat matrices."""
    flat = M.reshape(-1, M.shape[-1])
    return flat.T @ flat


def _expected(before: Variations, now: Step) -> tuple[Array, Array, Seen]:
    """The combinations of each run `(run, k, n)`, T, and the readings on their way.

    They are those of a run with the mean Jacobians and with what has arrived in this one: they may
    depend on what arrives, and not on the states.
    """
    T, G = before.factor, now.G if now.G.ndim == 2 else _mean(now.G)
    xi = np.concatenate([_mean(now.F) @ T, np.broadcast_to(G, (*T.shape[:-1], G.shape[-1]))], -1)
    seen = dict(before.expected or {})
    for key, H in now.taken.items():
        seen[key] = psd_root(_gram(H) / len(H)).T @ xi
    W = np.broadcast_to(np.eye(xi.shape[-1]), (len(xi), xi.shape[-1], xi.shape[-1])).copy()
    for key, here in now.arrived:
        k = seen[key].shape[-1]
        W[:, :k, :k] += _squares(seen[key], here)
    mix, factor = best_of_each(W, xi, [M for key, M in seen.items() if key in now.waiting])
    later = {key: M @ mix[:, : M.shape[-1]] for key, M in seen.items() if key in now.waiting}
    return mix, factor, later


def _squares(
    M: Float[Array, "run m k"], here: Bool[Mask, " run"] | None
) -> Float[Array, "run k k"]:
    """MᵀM, where the reading has arrived."""
    squares = M.mT @ M
    return squares if here is None else here[:, None, None] * squares


def _steering(mean: Float[Array, "n k"], G: Float[Array, "... n _"]) -> Float[Array, "_ n"]:
    """GᵀS⁻¹, S = mean meanᵀ + G Gᵀ: the noise that steers a variation back to its mean.

    It is the gain of the linear-quadratic problem whose cost is W. Without it the differences
    between the runs would grow where the system is unstable and the noise small.
    """
    G = G if G.ndim == 2 else _mean(G)
    root = np.linalg.qr(np.concatenate([mean, G], axis=-1).T, "r")
    size = np.abs(np.diag(root))
    if not size.size or size.min() <= REGULAR * size.max():
        return G.T @ np.linalg.pinv(root.T @ root, rcond=REGULAR**2, hermitian=True)
    half = solve_one_lower(root.T, G)
    return np.asarray(np.linalg.solve(root, half).T, np.float64)  # root is upper triangular


def _regular_inverse(G: Float[Array, "... n k"]) -> Float[Array, "n n"] | None:
    """The inverse of the mean of G over the runs, None where noise does not drive all coordinates.

    It need not be that of each run: any feedback gives a bound.
    """
    n, k = G.shape[-2:]
    if n != k:
        return None
    G = G if G.ndim == 2 else _mean(G)
    size = np.abs(G).sum(axis=1)
    if not size.all():
        return None
    left, values, right = np.linalg.svd(G / size[:, None])
    if values[-1] < REGULAR * values[0]:
        return None
    return np.asarray((right.T / values) @ left.T / size, np.float64)


def _counted(before: Variations, now: Step) -> tuple[Variations, Step]:
    """Both without the runs of which a number is not finite now, or was not before."""
    arrays = (now.F, *(now.taken.values()), *((now.G,) if now.G.ndim == 3 else ()))
    if before.counts.all() and surely_finite(*arrays):
        return before, now
    counts = before.counts.copy()
    for a in arrays:
        counts &= np.isfinite(a).all(axis=(-2, -1))
    step = Step(
        now.F[counts],
        now.G[counts] if now.G.ndim == 3 else now.G,
        {key: H[counts] for key, H in now.taken.items()},
        [(key, None if here is None else here[counts]) for key, here in now.arrived],
        now.waiting,
    )
    return _of_runs(before, counts), step


def _of_runs(before: Variations, counts: Mask) -> Variations:
    """The variations of some of the runs that counted."""
    rows = counts[before.counts]
    factor = before.factor[rows] if before.factor.ndim == 3 else before.factor
    return Variations(
        before.xi[rows], before.cost[rows],
        factor if counts.any() or factor.ndim == 3 else np.full_like(factor, np.nan),
        {key: M[rows] for key, M in before.waiting.items()},
        None if before.expected is None else {k: M[rows] for k, M in before.expected.items()},
        counts,
    )  # fmt: skip


def _centred(a: Float[Array, "run k n"]) -> Float[Array, "run k n"]:
    """The mean of the runs minus each; 0 for a column that is the same in all but for rounding."""
    out = _mean(a) - a
    spread, size = (np.square(b).sum(axis=(0, 1)) for b in (out, a))
    return np.where(spread > ROUNDING * size, out, 0.0)


def _mean(a: Float[Array, "run ..."]) -> Array:
    return a.sum(axis=0) / max(len(a), 1)
