"""How good a filter of a falling body could be: the posterior Cramér-Rao bound beside two filters.

A body falls through the air with an unknown ballistic coefficient; a radar 30.5 km aside
measures the distance to it (after Athans, Wishner & Bertolini 1968, in km and s). The model
has no process noise: what is unknown is the start.

    python examples/how_good.py
"""

import numpy as np

import estbench

STEPS, RUNS = 40, 300  # of 1 s
DECAY, ASIDE, NOISE = (
    0.164,
    30.5,
    0.0305,
)  # of the air's density, 1/km; the radar, km; its noise, km
MEAN = np.array([91.4, 6.1, 3.28])  # km, km/s, 1/km
PRIOR = np.diag([0.305, 0.61, 0.5]) ** 2


def fall(x, u, t, dt):
    """Height (km), speed downwards (km/s) and coefficient (1/km) after dt, in 20 steps of RK4."""

    def rate(x):
        height, speed, drag = np.moveaxis(x, -1, 0)
        braked = -np.exp(-DECAY * height) * speed**2 * drag
        return np.stack([-speed, braked, np.zeros_like(drag)], axis=-1)

    for _ in range(20):
        a = rate(x)
        b = rate(x + dt / 40 * a)
        c = rate(x + dt / 40 * b)
        d = rate(x + dt / 20 * c)
        x = x + dt / 120 * (a + 2 * b + 2 * c + d)
    return x


def distance(x, u, t):
    """Distance to the radar, km."""
    return np.hypot(ASIDE, x[..., :1] - ASIDE)


def main() -> dict[str, np.ndarray]:
    """Root mean square errors of the filters and the root of the bound `(time, 3)`; prints some."""
    model = estbench.FunctionModel(
        fall, distance, Q=np.zeros((3, 3)), R=np.array([[NOISE**2]]),
        names=("height", "speed", "drag"), units=("km", "km/s", "1/km"),
    )  # fmt: skip
    rng, times = np.random.default_rng(0), np.arange(STEPS + 1.0)
    x = np.empty((STEPS + 1, RUNS, 3))
    x[0] = MEAN + rng.standard_normal((RUNS, 3)) @ np.sqrt(PRIOR)
    u = np.zeros((RUNS, 0))
    for k in range(STEPS):
        x[k + 1] = fall(x[k], u, 0.0, 1.0)
    y = distance(x[1:], u, 0.0) + NOISE * rng.standard_normal((STEPS, RUNS, 1))
    bound = estbench.posterior_bound(model, MEAN, PRIOR, times, x)
    out = {"bound": np.sqrt(np.diagonal(bound.cov, axis1=1, axis2=2))}
    for name, estimator in (("ekf", estbench.EKF(model)), ("ukf", estbench.UKF(model))):
        prior = np.tile(MEAN, (RUNS, 1)), np.tile(PRIOR, (RUNS, 1, 1))
        history = estbench.follow(estimator, *prior, y, times=times)
        errors = x - np.array([belief.mean for belief in history.beliefs])
        out[name] = np.sqrt((errors**2).mean(axis=1))
    print("    s  height, m: bound     EKF     UKF")
    for k in range(0, STEPS + 1, 4):
        print(f"{k:5.1f}            " + "".join(f"{1000 * v[k, 0]:8.1f}" for v in out.values()))
    return out


if __name__ == "__main__":
    main()
