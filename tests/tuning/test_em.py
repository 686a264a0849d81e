import numpy as np
import pytest

from estbench.errors import StudyError
from estbench.models.linear import LinearModel
from estbench.tuning import em
from estbench.tuning.memory import Memory
from estbench.tuning.tune import fit
from tests.tuning import linear


@pytest.mark.parametrize("form", ["full", "diagonal", "factor"])
def test_the_likelihood_search_ends_at_a_fixed_point_of_em(form):
    y = linear.readings()
    found = fit(linear.parameters(), Memory(linear.given(y)))
    now = em.step(linear.model(found.values), *linear.prior(), y, Q=form, R=form)
    np.testing.assert_allclose([now.Q[0, 0], now.R[0, 0]], found.values, rtol=1e-6)


def test_em_converges_to_it():
    y = linear.readings()
    found = fit(linear.parameters(), Memory(linear.given(y)))
    reached = em.maximize(
        linear.model((0.2, 0.7)), *linear.prior(), y, iterations=150, tolerance=1e-7
    )
    assert reached.iterations < 150
    np.testing.assert_allclose(
        [reached.model.Q[0, 0], reached.model.R[0, 0]], found.values, rtol=1e-5
    )


def test_an_iteration_raises_the_likelihood_of_matrices():
    rng = np.random.default_rng(1)
    A, C = np.array([[0.9, 0.2], [-0.1, 0.8]]), np.array([[1.0, 0.0], [0.5, 1.0]])
    x, ys = rng.standard_normal((6, 2)), []
    for _ in range(25):
        x = x @ A.T + rng.standard_normal((6, 2)) @ np.array([[0.5, 0.2], [0.0, 0.3]])
        ys.append(x @ C.T + 0.4 * rng.standard_normal((6, 2)))
    y, prior = np.array(ys), (np.zeros((6, 2)), np.tile(np.eye(2), (6, 1, 1)))
    model = LinearModel(A, C, np.eye(2), np.eye(2))

    def likelihood(model):
        return linear.Given(lambda _: linear.KF(model), *prior, y)([()]).log_likelihood.sum()

    totals = [likelihood(model)]
    for _ in range(5):
        model = em.step(model, *prior, y)
        totals.append(likelihood(model))
    assert (np.diff(totals) > 0).all()


def test_mistakes():
    y = linear.readings()
    with pytest.raises(StudyError, match="use one of full, diagonal, factor, fixed"):
        em.maximize(linear.model((1, 1)), *linear.prior(), y, Q="scalar")
    y[3, 2] = np.nan
    with pytest.raises(StudyError, match="missing measurements"):
        em.maximize(linear.model((1, 1)), *linear.prior(), y)
