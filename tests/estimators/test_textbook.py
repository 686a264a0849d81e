"""Each filter against a plain version of its equations: one run, loops, inverses."""

from dataclasses import replace

import numpy as np
import pytest

from estbench.estimators.ekf import EKF
from estbench.estimators.ukf import UKF
from estbench.models.linear import LinearModel
from tests.helpers import nonlinear_model, random_cov

RUNS, STEPS, DT = 3, 4, 0.1
dimensions = pytest.mark.parametrize("n", [2, 4, 6])
seeds = pytest.mark.parametrize("seed", range(3))


def timed_model(n):
    """The chain of pendulums with a drive and a bias that depend on time."""
    model = nonlinear_model(n)
    f, h = model.f, model.h
    return replace(
        model,
        f=lambda x, u, t, dt: f(x, u * np.cos(t), t, dt),
        h=lambda x, u, t: h(x, u, t) + 0.1 * np.sin(t),
    )


class TextbookEKF:
    """Predict and update of Bishop's eq. 11 and 17-21."""

    def __init__(self, model, covariance_update):
        self.model, self.form = model, covariance_update

    def predict(self, x, P, u, t):
        F = self.model.f_jacobian(x, u, t, DT)
        return self.model.f(x, u, t, DT), F @ P @ F.T + self.model.Q

    def update(self, x, P, y, u, t):
        H, R = self.model.h_jacobian(x, u, t), self.model.R
        nu, S = y - self.model.h(x, u, t), H @ P @ H.T + R
        K = P @ H.T @ np.linalg.inv(S)
        A = np.eye(len(x)) - K @ H
        P = {
            "joseph": A @ P @ A.T + K @ R @ K.T,
            "simplified": A @ P,
            "symmetric": P - K @ S @ K.T,
        }[self.form]
        return x + K @ nu, P, nu, S


class TextbookUKF:
    """Van der Merwe 2004, eq. 3.11-3.13 and algorithm 3.1 with additive noise."""

    def __init__(self, model, redraw, alpha, beta, kappa):
        n = model.space.n
        self.model, self.redraw = model, redraw
        lam = alpha**2 * (n + kappa) - n
        self.scale = n + lam
        self.wm = [lam / (n + lam)] + [1 / (2 * (n + lam))] * (2 * n)
        self.wc = [lam / (n + lam) + 1 - alpha**2 + beta, *self.wm[1:]]

    def sigma(self, x, P):
        columns = np.linalg.cholesky(self.scale * P).T
        return [x] + [x + c for c in columns] + [x - c for c in columns]

    def cov(self, a, mean_a, b, mean_b):
        return sum(w * np.outer(p - mean_a, q - mean_b) for w, p, q in zip(self.wc, a, b))

    def predict(self, x, P, u, t):
        self.points = [self.model.f(p, u, t, DT) for p in self.sigma(x, P)]
        x = sum(w * p for w, p in zip(self.wm, self.points))
        return x, self.cov(self.points, x, self.points, x) + self.model.Q

    def update(self, x, P, y, u, t):
        points = self.sigma(x, P) if self.redraw else self.points
        images = [self.model.h(p, u, t) for p in points]
        predicted = sum(w * p for w, p in zip(self.wm, images))
        S = self.cov(images, predicted, images, predicted) + self.model.R
        K = self.cov(points, x, images, predicted) @ np.linalg.inv(S)
        nu = y - predicted
        return x + K @ nu, P - K @ S @ K.T, nu, S


def check(filter, textbooks, seed):
    """Several steps of one filter on RUNS runs against one textbook filter per run, at 1e-10."""
    model, rng = filter.model, np.random.default_rng(seed)
    n, m = model.space.n, model.output().n
    x, P = 0.3 * rng.standard_normal((RUNS, n)), random_cov(rng, n, RUNS, scale=0.2)
    belief = filter.init(x, P)
    beliefs = list(zip(x, P))

    def compare():
        np.testing.assert_allclose(
            filter.mean(belief), [b[0] for b in beliefs], rtol=1e-10, atol=1e-10
        )
        np.testing.assert_allclose(
            filter.cov(belief), [b[1] for b in beliefs], rtol=1e-10, atol=1e-10
        )
        assert not belief.fault.any()

    for step in range(STEPS):
        t = step * DT
        u = rng.standard_normal((RUNS, 1))
        belief = filter.predict(belief, u, t, DT)
        beliefs = [book.predict(*b, *row, t) for book, b, row in zip(textbooks, beliefs, zip(u))]
        compare()
        y = model.measurement(filter.mean(belief), u, t + DT) + 0.2 * rng.standard_normal((RUNS, m))
        belief, innovation = filter.update(belief, y, u, t + DT)
        results = [
            book.update(*b, *row, t + DT) for book, b, row in zip(textbooks, beliefs, zip(y, u))
        ]
        beliefs = [result[:2] for result in results]
        compare()
        nu, S = (np.array([result[i] for result in results]) for i in (2, 3))
        np.testing.assert_allclose(innovation.residual, nu, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(innovation.cov, S, rtol=1e-10, atol=1e-10)
        nis = [a @ np.linalg.inv(b) @ a for a, b in zip(nu, S)]
        np.testing.assert_allclose(innovation.nis, nis, rtol=1e-8)
        np.testing.assert_allclose((innovation.white**2).sum(axis=1), nis, rtol=1e-8)
        assert innovation.dof.tolist() == [m] * RUNS


@seeds
@dimensions
@pytest.mark.parametrize("form", ["joseph", "simplified", "symmetric"])
def test_ekf(form, n, seed):
    model = timed_model(n)
    check(EKF(model, form), [TextbookEKF(model, form) for _ in range(RUNS)], seed)


@seeds
@dimensions
@pytest.mark.parametrize("redraw", [True, False])
@pytest.mark.parametrize(
    ("alpha", "beta", "kappa"),
    [(1.0, 2.0, 0.0), (0.5, 2.0, 0.0), (0.2, 2.0, 1.0), (1.0, 0.0, 1.0), (0.7, 3.0, -1.0)],
)
def test_ukf(redraw, alpha, beta, kappa, n, seed):
    model = timed_model(n)
    textbooks = [TextbookUKF(model, redraw, alpha, beta, kappa) for _ in range(RUNS)]
    check(UKF(model, redraw, alpha, beta, kappa), textbooks, seed)


def test_the_joseph_form_outlasts_rounding_and_the_others_do_not():
    # A precise sensor beside a huge prior: only A P Aᵀ + K R Kᵀ keeps the digits of the small side.
    r, prior = 1e-10, 1e6 * np.array([[[1.0, 0.9], [0.9, 1.0]]])
    model = LinearModel(np.eye(2), np.array([[1.0, 0.1]]), np.zeros((2, 2)), np.array([[r]]))
    for form in ("joseph", "simplified", "symmetric"):
        filter = EKF(model, form)
        belief = filter.init(np.zeros((1, 2)), prior)
        for _ in range(3):
            belief, _ = filter.update(belief, np.ones((1, 1)), np.zeros((1, 0)), 0.0)
        kept = not belief.fault[0]
        if kept:
            smallest = np.linalg.eigvalsh(belief.cov[0]).min()
            kept = abs(smallest / (r / 3 / 1.01) - 1) < 0.1
        assert kept == (form == "joseph")


def test_without_redrawing_the_points_serve_one_update_only():
    # A second measurement at the same instant must see the first one's posterior.
    model, u = nonlinear_model(2), np.zeros((1, 1))
    kept, redrawn = UKF(model, redraw=False), UKF(model, redraw=True)
    belief = kept.predict(kept.init(np.zeros((1, 2)), 0.1 * np.eye(2)[None]), u, 0.0, DT)
    y = model.measurement(belief.mean, u, 0.0) + 0.1
    once, _ = kept.update(belief, y, u, 0.0)
    twice, _ = kept.update(once, y, u, 0.0)
    expected, _ = redrawn.update(redrawn.init(once.mean, once.cov), y, u, 0.0)
    np.testing.assert_allclose(twice.mean, expected.mean, rtol=1e-10, atol=1e-14)
    np.testing.assert_allclose(twice.cov, expected.cov, rtol=1e-10, atol=1e-14)
