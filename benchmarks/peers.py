"""The same cart-pole with estbench and with FilterPy, in one process: `python -m benchmarks.peers`.

Four states, four measurements (two encoders, two tachometers), Euler, dt 0.01 s. Both sides
simulate the truth, draw the sensors, filter, and compute NEES. FilterPy gets what helps it most:
Φ comes from MuJoCo's own `mjd_transitionFD`, in C, and H = I is known.
"""

import argparse
import statistics
import time
from collections.abc import Callable

import mujoco
import numpy as np
from filterpy.kalman import ExtendedKalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter
from mujoco.batch import Batch

from benchmarks.floor import floor
from estbench.experiment import setup
from estbench.montecarlo import batch, executors
from estbench.montecarlo import run as experiment
from estbench.robots.library import engine
from estbench.scenario import load as scenario

TACHOS = [
    'channels.cart_tacho={noise=0.05, add={type="jointvel", object="cart"}}',
    'channels.pole_tacho={noise=0.05, add={type="jointvel", object="pole"}}',
    'sensors=["cart_encoder", "pole_encoder", "cart_tacho", "pole_tacho"]',
    'control.kind="sine"',
    "control.amplitude=0.5",
]


def prepare(estimator: str, runs: int, steps: int) -> setup.Setup:
    """The benchmark's scenario for one estimator."""
    overrides = [
        *TACHOS, f"simulation.duration={steps * 0.01}", "control.observe=truth", "bound=false",
    ]  # fmt: skip
    resolved = scenario.load("cartpole", overrides)
    resolved = experiment.resolve(resolved, [estimator], runs=runs)
    return setup.build(resolved)


def ours(prepared: setup.Setup, threads: int) -> float:
    """Seconds for all runs on `threads` worker threads."""
    began = time.perf_counter()
    experiment.run(prepared.scenario, keep="summary", workers=threads)
    return time.perf_counter() - began


def over_floor(prepared: setup.Setup) -> float:
    """Wall time of all runs on one thread over the time inside their Batch calls."""
    runs = range(prepared.scenario.simulation.runs)
    size = batch.default_batch_size(prepared, "summary")
    with engine(), floor() as inside:
        began = time.perf_counter()
        for i in range(0, len(runs), size):
            batch.run_batch(prepared, runs[i : i + size], "summary")
        return (time.perf_counter() - began) / inside.seconds


def plain_calls(prepared: setup.Setup, points: int, rows: int = 1250) -> float:
    """Seconds per run and step of the Batch calls of a design that leaves nothing out.

    A step and a reading of the whole model for each of a filter's points, and for the truth.
    """
    batch = Batch(prepared.plant.model, rows, 1)
    batch.bind("sensordata")
    start = batch.state.copy()
    times = []
    with engine():
        for _ in range(50):
            batch.state[...] = start
            began = time.perf_counter()
            batch.step(nstep=1)
            batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)
            times.append(time.perf_counter() - began)
    return (points + 1) * statistics.median(times) / rows


Pair = tuple[float, float]


class Peer:
    """The cart-pole as a FilterPy user writes it: one run at a time on one MjData."""

    def __init__(self, prepared: setup.Setup):
        self.model = prepared.plant.model
        self.data = mujoco.MjData(self.model)
        self.prepared = prepared
        self.columns = np.concatenate([c.columns for c in prepared.channels])
        self.R = np.diag(np.concatenate([np.diag(c.cov) for c in prepared.channels]))
        self.Q = prepared.disturbance.density * self.model.opt.timestep
        self.u = 0.0

    def load(self, x: np.ndarray) -> None:
        self.data.qpos[:], self.data.qvel[:] = x[:2], x[2:]
        self.data.ctrl[:] = self.u

    def f(self, x: np.ndarray, dt: float = 0.01) -> np.ndarray:
        self.load(x)
        mujoco.mj_step(self.model, self.data)
        return np.concatenate([self.data.qpos, self.data.qvel])

    def h(self, x: np.ndarray) -> np.ndarray:
        self.load(x)
        mujoco.mj_step1(self.model, self.data)  # positions, velocities and their sensors
        return self.data.sensordata[self.columns]

    def transition_jacobian(self, x: np.ndarray) -> np.ndarray:
        self.load(x)
        F = np.zeros((4, 4))
        mujoco.mjd_transitionFD(self.model, self.data, 1e-6, 0, F, None, None, None)
        return F

    def ekf(self, x0: np.ndarray) -> tuple[Callable, Callable]:
        kf = ExtendedKalmanFilter(4, 4)
        kf.x, kf.P, kf.R, kf.Q = x0, self.prepared.cov.copy(), self.R, self.Q

        def step(y: np.ndarray) -> None:
            kf.F = self.transition_jacobian(kf.x)
            kf.P = kf.F @ kf.P @ kf.F.T + kf.Q
            kf.x = self.f(kf.x)
            kf.update(y, lambda x: np.eye(4), self.h)

        return step, lambda: (kf.x, kf.P)

    def ukf(self, x0: np.ndarray) -> tuple[Callable, Callable]:
        points = MerweScaledSigmaPoints(4, alpha=1.0, beta=2.0, kappa=0.0)
        kf = UnscentedKalmanFilter(4, 4, 0.01, self.h, self.f, points)
        kf.x, kf.P, kf.R, kf.Q = x0, self.prepared.cov.copy(), self.R, self.Q

        def step(y: np.ndarray) -> None:
            kf.predict()
            kf.sigmas_f = points.sigma_points(kf.x, kf.P)  # redrawn, as estbench's UKF does
            kf.update(y)

        return step, lambda: (kf.x, kf.P)

    def run(self, kind: str, runs: int, steps: int) -> tuple[float, float]:
        """Seconds, and the mean NEES as a check that it is the same problem."""
        rng = np.random.default_rng(0)
        root = np.linalg.cholesky(self.prepared.cov)
        noise, process = np.sqrt(np.diag(self.R)), np.sqrt(np.diag(self.Q))
        control = self.prepared.controller([0])
        total = 0.0
        began = time.perf_counter()
        for _ in range(runs):
            x = self.prepared.mean + root @ rng.standard_normal(4)
            step, belief = getattr(self, kind)(self.prepared.mean.copy())
            for k in range(steps):
                self.u = control(k, k * 0.01, x[None])[0]
                x = self.f(x) + process * rng.standard_normal(4)
                step(self.h(x) + noise * rng.standard_normal(4))
                mean, P = belief()
                e = x - mean
                total += e @ np.linalg.solve(P, e)
        return time.perf_counter() - began, total / (runs * steps)


def compare(kind: str, runs: int, peer_runs: int, steps: int, repeat: int) -> list[Pair]:
    """Microseconds per run and step of estbench and of FilterPy, measured in turn."""
    prepared = prepare(kind, runs, steps)
    peer, threads = Peer(prepared), executors.cpu_count()
    ours(prepare(kind, 50, 20), threads)
    pairs = []
    for _ in range(repeat):  # in turn, so that drift of the machine hits both alike
        mine = ours(prepared, threads) / (runs * steps)
        with engine():  # FilterPy too without MuJoCo's profiling callback
            seconds, nees = peer.run(kind, peer_runs, steps)
        if not 2 < nees < 6:
            raise RuntimeError(f"FilterPy's mean NEES is {nees}: not the same problem")
        pairs.append((1e6 * mine, 1e6 * seconds / (peer_runs * steps)))
    return pairs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=1000, help="runs of estbench")
    parser.add_argument("--peer-runs", type=int, default=10, help="runs of FilterPy")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--repeat", type=int, default=5)
    args = parser.parse_args()
    print(
        f"cartpole, {args.steps} steps of 0.01 s; {executors.cpu_count()} threads; median of "
        f"{args.repeat}\n"
        f"{'':8}{'estbench':>12}{'FilterPy':>12}{'ratio':>8}{'min':>7}{'max':>7}   over the floor"
    )
    for kind, target in (("ekf", 6), ("ukf", 12)):
        pairs = compare(kind, args.runs, args.peer_runs, args.steps, args.repeat)
        mine, theirs = (statistics.median(column) for column in zip(*pairs))
        ratios = [theirs / mine for mine, theirs in pairs]
        prepared = prepare(kind, args.runs, args.steps)
        floors = [over_floor(prepared) for _ in range(args.repeat)]
        plain = 1e6 * plain_calls(prepared, {"ekf": 5, "ukf": 9}[kind])
        alone = 1e6 * ours(prepared, 1) / (args.runs * args.steps)
        print(
            f"{kind:8}{mine:9.2f} µs{theirs:9.1f} µs{statistics.median(ratios):7.1f}x"
            f"{min(ratios):6.1f}x{max(ratios):6.1f}x"
            f"   {statistics.median(floors):.3f} ({min(floors):.3f}-{max(floors):.3f}),"
            f" targets {target}x, 1.25\n"
            f"        one thread {alone:.1f} µs; a step and a reading of the whole model for every "
            f"point: {plain:.1f} µs, {alone / plain:.2f}"
        )


if __name__ == "__main__":
    main()
