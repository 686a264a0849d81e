"""Each source's part of the error is the closed form of its own Lyapunov equation."""

import numpy as np
from scipy.linalg import block_diag, solve_discrete_are, solve_discrete_lyapunov

from estbench.budgets.recursion import Interval, Reading, Spread, predicted, updated

RNG = np.random.default_rng(5)
N, M, DRIFT = 3, 2, 2
F = RNG.standard_normal((N, N))
F *= 0.9 / np.abs(np.linalg.eigvals(F)).max()
H = RNG.standard_normal((M, N))
G = RNG.standard_normal((N, 2))
R = np.diag([0.3, 0.7])
KEEP, FRESH = np.array([0.9, 0.7]), np.array([0.02, 0.05])
Q = np.array([np.outer(g, g) for g in G.T])
NOISE = np.array([np.diag([0.3, 0.0]), np.diag([0.0, 0.7])])
PRIOR = solve_discrete_are(F.T, H.T, Q.sum(axis=0), R)
K = np.linalg.solve(H @ PRIOR @ H.T + R, H @ PRIOR).T


def settled(gain, columns=0, steps=400):
    """The spread after many steps with one gain: two process noises, two noises, a drift."""
    sources = 5
    pad = np.zeros((3, N, N))
    keep, fresh = np.zeros((2, sources, DRIFT))
    keep[4], fresh[4] = KEEP, FRESH
    over = Interval(F[None], np.concatenate([Q, pad]), None, keep, fresh)
    C = np.zeros((sources, M, DRIFT))
    C[4] = np.eye(M)
    noises = np.concatenate([np.zeros((2, M, M)), NOISE, np.zeros((1, M, M))])
    seen = Reading(H[None], noises, np.zeros((1, M, columns)), C)
    now = Spread(np.zeros((1, N, columns)), np.zeros((1, sources, N + DRIFT, N + DRIFT)))
    for _ in range(steps):
        now = updated(predicted(now, over), gain[None], seen)
    return now


def test_each_term_is_the_solution_of_its_lyapunov_equation():
    """With the optimal gain, and with one that is not: the terms add up to the whole."""
    for gain in (K, 0.5 * K):
        moving = settled(gain).moving[0]
        A = np.eye(N) - gain @ H
        step = A @ F
        whole = np.zeros((N, N))
        for s in range(2):
            expected = solve_discrete_lyapunov(step, A @ Q[s] @ A.T)
            np.testing.assert_allclose(moving[s, :N, :N], expected, rtol=0, atol=1e-10)
            whole += expected
        for s in range(2):
            expected = solve_discrete_lyapunov(step, gain @ NOISE[s] @ gain.T)
            np.testing.assert_allclose(moving[2 + s, :N, :N], expected, rtol=0, atol=1e-10)
            whole += expected
        both = np.block([[step, -gain @ np.diag(KEEP)], [np.zeros((M, N)), np.diag(KEEP)]])
        drive = np.concatenate([-gain, np.eye(M)]) @ np.diag(FRESH)
        drive = drive @ np.concatenate([-gain, np.eye(M)]).T
        drift = solve_discrete_lyapunov(both, drive)
        np.testing.assert_allclose(moving[4], drift, rtol=0, atol=1e-10)
        total = solve_discrete_lyapunov(
            step, A @ Q.sum(axis=0) @ A.T + gain @ R @ gain.T
        )  # of the white noises together
        np.testing.assert_allclose(moving[:4, :N, :N].sum(axis=0), total, rtol=0, atol=1e-10)
        np.testing.assert_allclose(whole, total, rtol=0, atol=1e-10)
    optimal = PRIOR - K @ H @ PRIOR
    np.testing.assert_allclose(
        settled(K).moving[0, :4, :N, :N].sum(axis=0), optimal, rtol=0, atol=1e-10
    )


def test_a_constant_ends_at_its_fixed_point():
    """A bias b of the readings: e = -(I - (I - K H) F)⁻¹ K b; a push d: (I - ...)⁻¹ (I - K H) d."""
    keep = np.zeros((0, 0))
    over = Interval(F[None], np.zeros((0, N, N)), None, keep, keep)
    bias, push = np.array([0.5, -1.0]), np.array([0.1, 0.2, -0.3])
    d = np.stack([np.zeros(N), push], axis=-1)[None]
    s = np.stack([bias, np.zeros(M)], axis=-1)[None]
    seen = Reading(H[None], np.zeros((0, M, M)), s, np.zeros((0, M, 0)))
    now = Spread(np.ones((1, N, 2)), np.zeros((1, 0, N, N)))
    for _ in range(400):
        now = updated(predicted(now, Interval(over.F, over.Q, d, keep, keep)), K[None], seen)
    A = np.eye(N) - K @ H
    left = np.eye(N) - A @ F
    np.testing.assert_allclose(left @ now.fixed[0, :, 0], -K @ bias, rtol=0, atol=1e-10)
    np.testing.assert_allclose(left @ now.fixed[0, :, 1], A @ push, rtol=0, atol=1e-10)


def test_sources_and_runs_do_not_mix():
    """Two runs with the block-diagonal filter of both equal one run with both robots."""
    rng = np.random.default_rng(1)
    gains = [K, rng.standard_normal((N, M)) * 0.1]
    Ps = [np.eye(N), 2 * np.eye(N)]
    keep = np.zeros((1, 0))
    over = Interval(np.stack([F, F.T]), Q[:1], None, keep, keep)
    seen = Reading(np.stack([H, -H]), NOISE[:1], np.zeros((2, M, 0)), np.zeros((1, M, 0)))
    now = Spread(np.zeros((2, N, 0)), np.stack(Ps)[:, None])
    now = updated(predicted(now, over), np.stack(gains), seen).moving[:, 0]
    joint = block_diag(*Ps)
    step, see = block_diag(F, F.T), block_diag(H, -H)
    gain = block_diag(*gains)
    A = np.eye(2 * N) - gain @ see
    joint = step @ joint @ step.T + block_diag(Q[0], Q[0])
    joint = A @ joint @ A.T + gain @ block_diag(NOISE[0], NOISE[0]) @ gain.T
    np.testing.assert_allclose(block_diag(*now), joint, rtol=0, atol=1e-12)
