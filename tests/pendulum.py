"""The pendulum of Särkkä & Svensson (2023), on which they print the errors of many filters."""

from pathlib import Path

import numpy as np

from estbench.estimators import registry
from estbench.following import follow
from estbench.models.function import FunctionModel

DT, GRAVITY = 0.01, 9.81
DATA = Path(__file__).parent / "data" / "pendulum.csv"


def model():
    """The discrete model of the book, sec. 7.2."""

    def f(x, u, t, dt):
        angle, rate = x[..., 0], x[..., 1]
        return np.stack([angle + dt * rate, rate - dt * GRAVITY * np.sin(angle)], axis=-1)

    Q = 0.01 * np.array([[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]])
    return FunctionModel(f, lambda x, u, t: np.sin(x[..., :1]), Q, 0.1 * np.eye(1))


def rmse(name, settings):
    """RMSE of the angle over the 500 steps of the printed data, from N(0, I)."""
    angle, y = np.loadtxt(DATA, delimiter=",", skiprows=5).T
    estimator = registry.create(name, settings, model())
    times = DT * np.arange(len(y) + 1)
    history = follow(estimator, np.zeros((1, 2)), np.eye(2)[None], y[:, None, None], times=times)
    smooth = getattr(estimator, "smooth", None)
    beliefs = smooth(history) if smooth else history.beliefs
    found = np.array([estimator.mean(belief)[0, 0] for belief in beliefs[1:]])
    return np.sqrt(np.mean((found - angle) ** 2))
