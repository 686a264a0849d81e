"""Tuning and sweeps: `python -m benchmarks.tuning`; `--only` for parts, `--runs` for precision.

calibration: standard errors of maximum likelihood on a linear-Gaussian model, over repetitions.
robots: Q and R started x 100 and x 0.01, the tuned filter on held-out runs. model: a filter whose
masses and damping are wrong. own: an estimator of one's own, and a particle filter by optuna.
speed: sets of candidates, simulations of the truth, and a sweep against the same filters as the
estimators of one run.
"""

import argparse
import re
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import estbench
from estbench.consistency.intervals import mean_interval, wilson
from estbench.estimators.kf import KF
from estbench.experiment.setup import Setup, build
from estbench.models.linear import LinearModel
from estbench.robots import parameters
from estbench.scenario.load import resolve
from estbench.scenario.schema import Scenario
from estbench.study import axes
from estbench.tables.quantity import percent, quantity
from estbench.tuning.given import Given
from estbench.tuning.memory import Memory
from estbench.tuning.parameters import Parameter
from estbench.tuning.result import Tuned
from estbench.tuning.tune import fit

Q, R = "filter.process_noise_scale", "filter.measurement_noise_scale"
A, C = np.array([[1.0, 0.1], [-0.2, 0.95]]), np.array([[1.0, 0.0]])
TRUE = (0.02, 0.1, 0.05)
"""Variances of w and v of the linear model."""
AXES = {
    "pendulum": ["hinge.vel"], "cartpole": ["cart.vel", "pole.vel"],
    "quadrotor": ["root.v?", "root.w?"],
}  # fmt: skip
"""Coordinates whose Q is recovered, by robot."""
ANT = Path(__file__).parents[1] / "examples" / "gymnasium" / "ant.toml"


def linear(values: Sequence[float]) -> LinearModel:
    """The linear model with variances q1, q2, r."""
    return LinearModel(A, C, np.diag(values[:2]), np.array([[values[2]]]))


def readings(rng: np.random.Generator, runs: int, steps: int) -> np.ndarray:
    """Measurements `(step, run, 1)` of the true model."""
    x, out = rng.standard_normal((runs, 2)), []
    for _ in range(steps):
        x = x @ A.T + rng.standard_normal((runs, 2)) * np.sqrt(TRUE[:2])
        out.append(x @ C.T + rng.standard_normal((runs, 1)) * np.sqrt(TRUE[2]))
    return np.array(out)


def estimate(seed: int, runs: int, steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """ln(estimate/truth) and its standard errors, started a factor of 100 off."""
    y = readings(np.random.default_rng(seed), runs, steps)
    mean, cov = np.zeros((runs, 2)), np.tile(np.eye(2), (runs, 1, 1))
    source = Given(lambda values: KF(linear(values)), mean, cov, y)
    free = tuple(
        Parameter((name,), name, f * x, f * x / 1e4, f * x * 1e4, True)
        for name, x, f in zip(("q1", "q2", "r"), TRUE, (100.0, 0.01, 100.0))
    )
    found = fit(free, Memory(source))
    assert found.uncertainty is not None
    return np.log(np.divide(found.values, TRUE)), found.uncertainty.std, found.uncertainty.robust


def calibration(args: argparse.Namespace) -> None:
    """Errors over standard errors, and coverage of the intervals."""
    print(f"## calibration: {args.repetitions} repetitions, 20 runs x 50 steps, started x 100 off")
    found = [estimate(seed, 20, 50) for seed in range(args.repetitions)]
    error, std, robust = (np.array(column) for column in zip(*found))
    print("| | mean error/σ | std of error/σ | largest | 95% covers | robust covers |")
    print("|---|---|---|---|---|---|")
    for j, name in enumerate(("q1", "q2", "r")):
        firm = np.isfinite(std[:, j])
        z, other = error[firm, j] / std[firm, j], error[firm, j] / robust[firm, j]
        inside = [int((np.abs(x) < 1.96).sum()) for x in (z, other)]
        covers = " | ".join(percent(wilson(n, len(z)), 0) for n in inside)
        print(
            f"| {name} ({firm.sum()}) | {quantity(mean_interval(z))} | {z.std(ddof=1):.2f} | "
            f"{np.abs(z).max():.2f} | {covers} |", flush=True,
        )  # fmt: skip


def report(title: str, tuned: Tuned, began: float) -> None:
    """One row of a table."""
    held = tuned.held_out
    assert held is not None
    values = ", ".join(
        f"{re.split(r'density[.]|set[.]|filter[.]', p.key)[-1]} "
        f"{quantity(i) if i is not None else v}"
        for p, v, i in zip(tuned.parameters, tuned.values, tuned.intervals)
    )
    ratio = float(np.exp(np.mean([np.log(i.value) for i in held.rmse])))
    print(
        f"| {title} | {values} | {held.before.verdict}, {quantity(held.before.anees)} | "
        f"{held.after.verdict}, {quantity(held.after.anees)} | {quantity(held.likelihood)} | "
        f"{ratio:.3f} | {tuned.batches} sets, {tuned.candidates} | "
        f"{time.monotonic() - began:.0f} |",
        flush=True,
    )


HEAD = (
    "| | tuned (95%) | held-out before | after | log-lik. change per run | RMSE after/before | "
    "computed | s |\n|---|---|---|---|---|---|---|---|"
)


def robots(args: argparse.Namespace) -> None:
    """Q and R started x 100 and x 0.01; then Q of each coordinate, started x 100."""
    print(f"## robots: {args.runs} runs x {args.duration:g} s, as many held-out\n{HEAD}")
    short = {"runs": args.runs, "duration": args.duration}
    for name in args.robots:
        source, estimator = (str(ANT), "rotated_ukf") if name == "ant" else (name, "ekf")
        for q, r in ((100, 0.01), (0.01, 100)):
            began = time.monotonic()
            start = [f"{Q}={q}", f"{R}={r}"]
            tuned = estbench.tune(source, estimator, [Q, R], overrides=start, **short)
            report(f"{name} {estimator}, Q x {q}, R x {r}", tuned, began)
        if name not in AXES:
            continue
        began = time.monotonic()
        prepared = estbench.load(name).process_noise.density
        assert isinstance(prepared, dict)
        true = [prepared.get(axis, prepared.get("*.vel", 0.0)) for axis in AXES[name]]
        free = [f'filter.process_noise.density."{axis}"' for axis in AXES[name]]
        start = [f"{key}={100 * value:g}" for key, value in zip(free, true)]
        tuned = estbench.tune(name, "ekf", free, overrides=start, **short)
        report(f"{name}, per coordinate x 100 (true {true})", tuned, began)


def model(args: argparse.Namespace) -> None:
    """A filter whose mass is 20% high, its damping half: what Q buys, what the mass buys."""
    print(f"## model: pendulum, {args.runs} runs x {args.duration:g} s\n{HEAD}")
    wrong = {"body_mass.arm": 1.2, "dof_damping.hinge": 0.5}
    built = build(resolve("pendulum", ["ekf"], runs=2))
    overrides, true = [], {}
    for key, factor in wrong.items():
        field, rows = parameters.parameter(built.plant.model, key, "model")
        true[key] = float(np.mean(getattr(built.plant.model, field)[rows]))
        overrides.append(f'filter.set."{key}"={factor * true[key]:g}')
    mass, damping = (f'filter.set."{key}"' for key in wrong)
    for title, free in (("Q", [Q]), ("mass", [mass]), ("mass, damping, Q", [mass, damping, Q])):
        began = time.monotonic()
        tuned = estbench.tune(
            "pendulum", "ekf", free, runs=args.runs, duration=args.duration, overrides=overrides
        )
        report(f"free: {title} (true {true})", tuned, began)


def own(args: argparse.Namespace) -> None:
    """A setting of one's own estimator, and a particle filter's size and regularization."""
    print(f"## own: pendulum, {args.runs} runs x {args.duration:g} s\n{HEAD}")
    began = time.monotonic()
    tuned = estbench.tune(
        "pendulum", "examples.my_filter:MyFilter", ["scale"], runs=args.runs,
        duration=args.duration, overrides=["estimators.MyFilter.scale=100.0"],
    )  # fmt: skip
    report("examples.my_filter, scale x 100", tuned, began)
    try:
        began = time.monotonic()
        tuned = estbench.tune(
            "pendulum", "pf", ["size=100,300,1000", "regularization=0.01:2"], runs=20,
            duration=0.5, objective="mse", method="optuna", iterations=20,
            overrides=["estimators.pf.size=100", "estimators.pf.regularization=0.05"],
        )  # fmt: skip
        report("pf by optuna", tuned, began)
    except estbench.EstbenchError as error:
        print(f"(pf by optuna: {error})")


def speed(args: argparse.Namespace) -> None:
    """Sets of candidates and simulations of a tuning; a sweep against its filters alone."""
    counted: list[int] = []
    original = Setup.simulator

    def counting(self: Setup, runs: Sequence[int]):
        counted.append(len(runs))
        return original(self, runs)

    Setup.simulator = counting  # type: ignore[method-assign]
    free = ['filter.process_noise.density."cart.vel"', 'filter.process_noise.density."pole.vel"',
            "filter.channels.cart_encoder.noise", "filter.channels.pole_encoder.noise"]  # fmt: skip
    began = time.monotonic()
    tuned = estbench.tune(
        "cartpole", "ekf", free, runs=args.runs, duration=args.duration, held_out=0,
        overrides=[f"{free[0]}=1.0", f"{free[1]}=0.0001"],
    )  # fmt: skip
    print(
        f"## speed: 4 parameters of the cart-pole EKF, {args.runs} runs x {args.duration:g} s: "
        f"{tuned.batches} sets, {tuned.candidates} candidates, {sum(counted)} runs simulated, "
        f"{time.monotonic() - began:.0f} s; to {dict(zip(free, tuned.values))}", flush=True,
    )  # fmt: skip
    Setup.simulator = original  # type: ignore[method-assign]
    values = axes.Range(0.01, 100.0, log=True).at(np.linspace(0, 1, 30).tolist())
    short = {"runs": args.runs, "duration": args.duration, "workers": 1}
    data = resolve("cartpole", ["ekf"]).model_dump(exclude_none=True)
    data["estimators"] = {
        f"q{i}": {"type": "ekf", "filter": {"process_noise_scale": q}} for i, q in enumerate(values)
    }
    alone = Scenario.model_validate(data)
    costs = []
    for _ in range(args.turns):
        began = time.process_time()
        estbench.sweep("cartpole", {Q: values}, ["ekf"], **short)
        half = time.process_time()
        estbench.run(alone, keep="summary", **short)
        costs.append((half - began, time.process_time() - half))
    sweep, filters = np.min(costs, axis=0)
    print(
        f"sweep of 30 variants: {sweep:.1f} s of CPU; the 30 filters as estimators of one run "
        f"{filters:.1f} s, ratio {sweep / filters:.3f} (least of {args.turns} turns)"
    )


GROUPS = {
    "calibration": calibration, "robots": robots, "model": model, "own": own, "speed": speed,
}  # fmt: skip


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", choices=GROUPS, default=list(GROUPS))
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--duration", type=float, default=5.0, help="s")
    parser.add_argument("--repetitions", type=int, default=100, help="of the calibration")
    parser.add_argument("--turns", type=int, default=3, help="of the sweep's cost")
    parser.add_argument(
        "--robots", nargs="+", choices=[*AXES, "ant"], default=list(AXES),
        help="of the group robots; the ant takes minutes for 12 runs x 0.5 s",
    )  # fmt: skip
    args = parser.parse_args()
    for group in args.only:
        GROUPS[group](args)


if __name__ == "__main__":
    main()
