"""The Kalman filter and the Rauch-Tung-Striebel smoother in exact arithmetic, of rationals."""

from fractions import Fraction

import numpy as np


def rational(a):
    """An array of `Fraction` that is equal to one of floats."""
    return np.vectorize(Fraction, otypes=[object])(np.asarray(a, float))


def inverse(a):
    """Of a small array of `Fraction`, by Gauss and Jordan."""
    n = len(a)
    joint = np.concatenate([a, rational(np.eye(n))], axis=1)
    for i in range(n):
        pivot = next(k for k in range(i, n) if joint[k, i] != 0)
        joint[[i, pivot]] = joint[[pivot, i]]
        joint[i] = joint[i] / joint[i, i]
        for k in range(n):
            if k != i:
                joint[k] = joint[k] - joint[k, i] * joint[i]
    return joint[:, n:]


def floats(pairs):
    return [(mean.astype(float), cov.astype(float)) for mean, cov in pairs]


def _filtered(A, C, Q, R, x, P, ys):
    A, C, Q, R, x, P, ys = map(rational, (A, C, Q, R, x, P, ys))
    posteriors, priors = [(x, P)], []
    for y in ys:
        x, P = A @ x, A @ P @ A.T + Q
        priors.append((x, P))
        K = P @ C.T @ inverse(C @ P @ C.T + R)
        x, P = x + K @ (y - C @ x), P - K @ C @ P
        posteriors.append((x, P))
    return A, posteriors, priors


def exact_filter(A, C, Q, R, x, P, ys):
    """Mean and covariance after each of `ys`: predict, then update."""
    return floats(_filtered(A, C, Q, R, x, P, ys)[1][1:])


def exact_smoother(A, C, Q, R, x, P, ys):
    """Smoothed mean and covariance at the start and after each of `ys`; P⁻ must be regular."""
    A, posteriors, priors = _filtered(A, C, Q, R, x, P, ys)
    smoothed = [posteriors[-1]]
    for (m, P), (ahead, S) in zip(posteriors[-2::-1], priors[::-1]):
        G = P @ A.T @ inverse(S)
        x, V = smoothed[0]
        smoothed.insert(0, (m + G @ (x - ahead), P + G @ (V - S) @ G.T))
    return floats(smoothed)
