"""Filters of a pendulum of functions (n = 2, m = 1), no MuJoCo: `python -m benchmarks.small`.

CPU µs per run and step, least and median of several passes in turn: numpy alone, the compiled loops
of the extra `fast`, and dynamax (JAX, jitted, float64) on the same readings. What is not installed
is left out.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from typing import Any
from unittest import mock

import numpy as np

from estbench.estimators.ekf import EKF
from estbench.estimators.ukf import UKF
from estbench.models.function import FunctionModel
from estbench.spaces import fused

DT, RUNS, STEPS = 0.01, 1000, 200
START, P0 = np.array([1.0, 0.0]), 0.1 * np.eye(2)
Q, R = np.diag([1e-5, 1e-4]), np.array([[0.01]])


def f(x: Any, u: Any = None, t: float = 0.0, dt: float = DT) -> Any:
    """Euler's step of the pendulum."""
    return np.stack([x[..., 0] + dt * x[..., 1], x[..., 1] - 9.81 * dt * np.sin(x[..., 0])], -1)


def f_jacobian(x: Any, u: Any, t: float, dt: float) -> Any:
    out = np.tile(np.array([[1.0, dt], [0.0, 1.0]]), (*x.shape[:-1], 1, 1))
    out[..., 1, 0] = -9.81 * dt * np.cos(x[..., 0])
    return out


def h(x: Any, u: Any = None, t: float = 0.0) -> Any:
    """The bob's place along the horizontal."""
    return np.sin(x[..., :1])


def h_jacobian(x: Any, u: Any, t: float) -> Any:
    return np.stack([np.cos(x[..., 0]), np.zeros(x.shape[:-1])], -1)[..., None, :]


def readings() -> Any:
    """Readings `(time, run, 1)` of runs with process noise."""
    rng = np.random.default_rng(0)
    x, out = np.tile(START, (RUNS, 1)), np.empty((STEPS, RUNS, 1))
    for y in out:
        x = f(x) + rng.standard_normal(x.shape) * np.sqrt(np.diag(Q))
        y[:] = h(x) + 0.1 * rng.standard_normal(y.shape)
    return out


def ours(kind: Callable[..., Any], y: Any) -> Callable[[], Any]:
    """All runs as one batch; the last means."""
    model = FunctionModel(f, h, Q, R, f_jacobian=f_jacobian, h_jacobian=h_jacobian)
    estimator, u = kind(model), np.zeros((RUNS, 0))

    def call() -> Any:
        belief = estimator.init(np.tile(START, (RUNS, 1)), np.tile(P0, (RUNS, 1, 1)))
        for k in range(STEPS):
            belief = estimator.predict(belief, u, k * DT, DT)
            belief, _ = estimator.update(belief, y[k], u, k * DT)
        return belief.mean

    return call


def dynamax(kind: str, y: Any) -> Callable[[], Any]:
    """The filter of dynamax, jitted over time and mapped over the runs."""
    jax, jnp = import_module("jax"), import_module("jax.numpy")
    jax.config.update("jax_enable_x64", True)
    peer = import_module("dynamax.nonlinear_gaussian_ssm")
    parameters = peer.ParamsNLGSSM(
        START, P0,
        lambda x: jnp.array([x[0] + DT * x[1], x[1] - 9.81 * DT * jnp.sin(x[0])]), Q,
        lambda x: jnp.sin(x[:1]), R,
    )  # fmt: skip

    def run(y: Any) -> Any:
        if kind == "ekf":
            return peer.extended_kalman_filter(parameters, y).filtered_means
        return peer.unscented_kalman_filter(parameters, y, peer.UKFHyperParams()).filtered_means

    jitted = jax.jit(jax.vmap(run))
    given = jnp.array(np.swapaxes(y, 0, 1))
    return lambda: jitted(given).block_until_ready()


def without_loops(call: Callable[[], Any]) -> Callable[[], Any]:
    """The same by numpy."""

    def plain() -> Any:
        with mock.patch.object(fused, "compiled", return_value=None):
            return call()

    return plain


def ways(name: str) -> dict[str, Callable[[], Any]]:
    """Way -> a pass of the filter, for each way that is installed; all are compiled."""
    y, kind = readings(), {"ekf": EKF, "ukf": UKF}[name]
    found = {"numpy": without_loops(ours(kind, y))}
    if fused.compiled():
        found["fast"] = ours(kind, y)
    if find_spec("dynamax"):
        found["dynamax"] = dynamax(name, y)
    for call in found.values():
        call()
    return found


def cost(call: Callable[[], Any]) -> float:
    """CPU µs per run and step of a pass."""
    began = time.process_time()
    call()
    return 1e6 * (time.process_time() - began) / (RUNS * STEPS)


def main() -> None:
    """Print a line for each filter and way."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeat", type=int, default=15)
    args = parser.parse_args()
    for name in ("ekf", "ukf"):
        passes = ways(name)
        taken: dict[str, list[float]] = {way: [] for way in passes}
        for _ in range(args.repeat):
            for way, call in passes.items():
                taken[way].append(cost(call))
        for way, costs in taken.items():
            print(
                f"{name} {way:8} {min(costs):6.3f} {statistics.median(costs):6.3f} µs", flush=True
            )


if __name__ == "__main__":
    main()
