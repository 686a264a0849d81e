"""Every speed target in one table: `python -m benchmarks` (half an hour; `--only` for parts).

Ratios are taken within one run, since machines differ and are shared: against the Batch calls that
a filter makes, against a bare C `mj_step`, against FilterPy and dynamax (`pip install dynamax`;
left out where it is not installed). docs/performance.md says how to read them.
"""

import argparse
import logging
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import gymnasium as gym
import mujoco
import numpy as np

from benchmarks import cores, envs, peers, small
from estbench.experiment import setup
from estbench.montecarlo import executors
from estbench.montecarlo import run as experiment
from estbench.robots.library import engine
from estbench.scenario import load as scenario

# 21 sensor values on Gymnasium's ant (n = 28): 8 encoders, pose, velocities of the torso.
ANT = [
    f'channels.{name}={{noise=0.05, add={{type="{kind}", object="torso", object_type="xbody"}}}}'
    for name, kind in (("linear", "framelinvel"), ("angular", "frameangvel"))
]
FILTERS = ("ekf", "ukf")


@dataclass(frozen=True)
class Target:
    """A figure that is wanted: at most `limit`, or at least.

    Attributes:
        name: what is measured.
        limit: the target.
        least: whether the figure is to be at least the limit.
        unit: of the figure.
        measure: called once a repetition.
    """

    name: str
    limit: float
    least: bool
    unit: str
    measure: Callable[[], float]


def ant(kind: str, runs: int, steps: int) -> setup.Setup:
    """Gymnasium's ant, shaken, with 21 sensor values."""
    overrides = [*ANT, f"simulation.duration={steps * 0.01}", "bound=false"]
    resolved = scenario.load("examples/gymnasium/ant.toml", overrides)
    return setup.build(experiment.resolve(resolved, [kind], runs=runs))


def against_floor() -> Iterator[Target]:
    """Wall time over the time inside the Batch calls, 1000 runs, one thread."""
    for robot, prepare, steps, limit in (
        ("cartpole", peers.prepare, 200, 1.15),
        ("ant", ant, 20, 1.1),
    ):
        for kind in FILTERS:
            prepared = prepare(kind, 1000, steps)
            yield Target(
                f"{kind} on {robot}: wall / own Batch calls", limit, False, "",
                partial(peers.over_floor, prepared),
            )  # fmt: skip


def all_cores() -> Iterator[Target]:
    """Ten seconds of one core with `--executor auto` on all, whose processes stand already."""
    for kind in FILTERS:
        yield Target(
            f"{kind} on cartpole: all cores / one", 1.85, True, "x",
            partial(speedup, cores.sized("cartpole", kind, 10.0)),
        )  # fmt: skip
    yield Target("ekf on ant: all cores / one", 1.85, True, "x", partial(speedup, ant_of_ten()))


def ant_of_ten() -> setup.Setup:
    """The ant's EKF for ten seconds of one core."""
    return cores.sized("examples/gymnasium/ant.toml", "ekf", 10.0)


def speedup(prepared: setup.Setup) -> float:
    """Throughput of all cores over that of one."""
    return cores.speedups(prepared, executors.cpu_count())[2]


def functions() -> Iterator[Target]:
    """Two states without MuJoCo: the compiled loops where they are installed, over dynamax."""
    for kind in FILTERS:
        passes = small.ways(kind)
        if "dynamax" not in passes:
            print("dynamax is not installed: pip install dynamax")
            return
        ours, theirs = passes.get("fast", passes["numpy"]), passes["dynamax"]
        yield Target(
            f"{kind} of functions: ours / dynamax", 1.0, False, "",
            partial(over, ours, theirs),
        )  # fmt: skip


def over(ours: Callable[[], object], theirs: Callable[[], object], rounds: int = 5) -> float:
    """CPU time of one over that of the other, the least of some passes in turn."""
    taken = [(small.cost(ours), small.cost(theirs)) for _ in range(rounds)]
    mine, other = map(min, zip(*taken))
    return mine / other


def against_c() -> Iterator[Target]:
    """CPU time of predict + update of one run, in bare C steps of the same model."""
    limits = {
        ("cartpole", "ekf"): 12,
        ("cartpole", "ukf"): 10,
        ("ant", "ekf"): 31,
        ("ant", "ukf"): 56,
    }
    for (robot, kind), limit in limits.items():
        prepared = (peers.prepare if robot == "cartpole" else ant)(kind, 250, 10)
        yield Target(
            f"{kind} on {robot}: CPU of an update / mj_step", limit, False, "",
            partial(equivalents, prepared, kind),
        )  # fmt: skip


def equivalents(prepared: setup.Setup, kind: str, rounds: int = 12) -> float:
    """CPU time of a run's predict + update over that of `mj_step`, each the best of some."""
    rng = np.random.default_rng(0)
    runs, dt = 250, prepared.plant.period
    mean, cov = (np.repeat(a[None], runs, axis=0) for a in prepared.prior(kind))
    spread = rng.standard_normal((runs, prepared.space.n)) @ np.linalg.cholesky(cov[0]).T
    model = prepared.plant.model
    u = np.zeros((runs, model.nu))
    estimator = prepared.estimator(kind)
    # Some steps on: an ant just let go has contacts and joint limits to settle.
    x = estimator.model.transition(prepared.space.plus(mean, spread), u, 0.0, 30 * dt)
    channels = tuple(c.name for c in prepared.channels)

    def update() -> None:
        prior = estimator.predict(belief, u, 0.0, dt)
        estimator.update(prior, y, u, dt, channels)

    def steps() -> None:
        for row in x[:50]:
            data.qpos[:], data.qvel[:] = row[: model.nq], row[model.nq : model.nq + model.nv]
            mujoco.mj_step(model, data, 5)

    with engine(), np.errstate(invalid="ignore"):
        data = mujoco.MjData(model)
        belief = estimator.init(x, cov)
        y = estimator.model.measurement(x, u, dt, channels)
        ours = min(cpu(update) for _ in range(rounds)) / runs
        return ours / (min(cpu(steps) for _ in range(rounds)) / (50 * 5))


def cpu(call: Callable[[], None]) -> float:
    """CPU seconds of this thread in a call."""
    began = time.thread_time()
    call()
    return time.thread_time() - began


def against_peers() -> Iterator[Target]:
    """Against FilterPy over the same model, truth, sensors and NEES included, on all cores."""
    for kind, limit in (("ekf", 10), ("ukf", 20)):
        yield Target(f"{kind} on cartpole: FilterPy / ours", limit, True, "x", partial(ratio, kind))


def ratio(kind: str) -> float:
    """FilterPy's time over ours, per run and step."""
    ((mine, theirs),) = peers.compare(kind, 1000, 10, 200, 1)
    return theirs / mine


def one_run() -> Iterator[Target]:
    """Predict + update of a batch of one, as in a control loop."""
    prepared = peers.prepare("ekf", 10, 10)
    mean, cov = prepared.prior("ekf")
    estimator = prepared.estimator("ekf")
    belief, u = estimator.init(mean[None], cov[None]), np.zeros((1, 1))
    channels = tuple(c.name for c in prepared.channels)

    def step() -> None:
        prior = estimator.predict(belief, u, 0.0, 0.01)
        estimator.update(prior, np.zeros((1, 4)), u, 0.01, channels)

    def measure() -> float:
        with engine():
            return envs.best(step, 2000)

    yield Target("ekf on cartpole: one run's update", 100, False, "µs", measure)


def environments() -> Iterator[Target]:
    """The step of an environment with an EKF."""
    pendulum = "InvertedPendulum-v5"
    bare = envs.stepping(gym.make(pendulum))
    seen = envs.stepping(envs.wrapped(pendulum, "ekf", observe="env"))
    yield Target(
        f"ekf around {pendulum}: added", 130, False, "µs",
        lambda: envs.best(seen) - envs.best(bare),
    )  # fmt: skip
    native = envs.stepping(gym.make("estbench/CartPole-v0"))
    yield Target("ekf in the native cart-pole: a step", 80, False, "µs", partial(envs.best, native))
    rows = envs.cartpoles(executors.cpu_count())
    yield Target(
        f"ekf in {envs.ROWS} native cart-poles: steps/s", 200_000, True, "",
        lambda: envs.ROWS / statistics.mean(envs.step_times(rows)),
    )  # fmt: skip
    for kind in FILTERS:
        one, shared = (
            envs.stepping(envs.wrapped("HalfCheetah-v5", kind, nthread=n), 1.0) for n in (1, None)
        )
        yield Target(
            f"{kind} around HalfCheetah-v5: all cores / one", 1.6, True, "x",
            partial(faster, shared, one),
        )  # fmt: skip


def faster(step: Callable[[], None], than: Callable[[], None]) -> float:
    """Steps a second of one over those of the other."""
    return envs.rate(step) / envs.rate(than)


def scaling() -> Iterator[Target]:
    """CPU time per run of the EKF on cartpole, summary kept, one thread, 500 to 50,000 runs."""

    def measure() -> float:
        costs = []
        for runs, times in ((500, 5), (5000, 1), (50_000, 1)):
            prepared = peers.prepare("ekf", runs, 200)
            # The median of the small ones: they are over before the machine has changed.
            spent = []
            for _ in range(times):
                began = time.process_time()
                peers.ours(prepared, 1)
                spent.append(time.process_time() - began)
            costs.append(statistics.median(spent) / runs)
        return max(costs) / min(costs)

    yield Target(
        "ekf on cartpole: CPU per run, 500 to 50,000 runs, max / min", 1.1, False, "", measure
    )


GROUPS: dict[str, Callable[[], Iterator[Target]]] = {
    "floor": against_floor, "cores": all_cores, "c": against_c, "peers": against_peers,
    "functions": functions, "one": one_run, "envs": environments, "scaling": scaling,
}  # fmt: skip


def shown(value: float) -> str:
    """A figure in eight characters."""
    return f"{value:8.0f}" if value >= 1000 else f"{value:8.3f}"


def main() -> None:
    logging.getLogger("estbench").setLevel(logging.ERROR)  # which sensors an environment is given
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", choices=GROUPS, default=list(GROUPS))
    parser.add_argument("--repeat", type=int, default=5)
    args = parser.parse_args()
    print(f"{executors.cpu_count()} cores; {args.repeat} repetitions", flush=True)
    print(f"{'':62}{'median':>8}{'min':>8}{'max':>8}  target")
    for group in args.only:
        for target in GROUPS[group]():
            got = [target.measure() for _ in range(args.repeat)]
            middle = statistics.median(got)
            met = middle >= target.limit if target.least else middle <= target.limit
            print(
                f"{target.name:62}{shown(middle)}{shown(min(got))}{shown(max(got))}  "
                f"{'>=' if target.least else '<='} {target.limit:g}{target.unit} "
                f"{'met' if met else 'NOT MET'}",
                flush=True,
            )


if __name__ == "__main__":
    main()
