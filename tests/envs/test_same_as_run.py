"""An environment is the run: stepped with its controls it gives its truth, readings and estimates.

To the last bit, for every bundled scenario and every example, scalar and vector.
"""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import estbench.envs
from estbench.envs.world import World
from estbench.experiment import setup
from estbench.experiment.recording import followed, trajectory
from estbench.montecarlo import run as montecarlo
from estbench.robots.controls import ControlRange
from estbench.simulation.sources import Recorded

ROOT = Path(__file__).parents[2]
SCENARIOS = sorted(
    str(path.relative_to(ROOT))
    for folder in ("assets", "examples")
    for path in (ROOT / folder).rglob("*.toml")
    if path.name != "pyproject.toml"
)
MORE = {
    "everything late": (
        "assets/cartpole/scenario.toml",
        (
            "model.timestep=0.002", "model.frame_skip=5", "channels.cart_encoder.jitter=0.004",
            "channels.cart_encoder.latency=0.012", "channels.cart_encoder.latency_std=0.006",
            "channels.pole_encoder.rate=71.42857142857143", "channels.pole_encoder.dropout=0.2",
            "channels.pole_encoder.stuck=0.02", "channels.pole_encoder.bias_walk=0.01",
            "channels.pole_encoder.outlier_probability=0.1",
        ),
    ),
    "believed latency": (
        "assets/pendulum/scenario.toml",
        ("channels.encoder.latency=0.05", "filter.channels.encoder.latency=0.02"),
    ),
    "no belief in latency": (
        "assets/pendulum/scenario.toml",
        ("channels.encoder.latency=0.05", "filter.channels.encoder.latency=0.0"),
    ),
    "short window": (
        "assets/pendulum/scenario.toml",
        ("channels.encoder.latency=0.03", "channels.encoder.latency_std=0.02",
         "filter.window=0.03"),
    ),
    "sensors see the disturbance": (
        "assets/quadrotor/scenario.toml", ("process_noise.accelerometer_sees=disturbance",),
    ),
    "schedules and draws": (
        "assets/pendulum/scenario.toml",
        (
            "channels.gyro.schedule=[[0.1, 1.0], [9.0, 4.0]]",
            "process_noise.schedule=[[0.2, 1.0], [9.0, 9.0]]",
            "truth.draw.'body_mass.arm'.relative_std=0.1",
        ),
    ),
}  # fmt: skip
CASES = {name: (name, ()) for name in SCENARIOS} | MORE


def resolved(case, duration=None):
    path, overrides = CASES[case]
    scenario = estbench.scenario.load.load(ROOT / path, list(overrides))
    periods = 40 if scenario.simulation.duration < 30 else 15
    period = setup.build(scenario).plant.period
    return montecarlo.resolve(scenario, duration=duration or periods * period)


def simulated(prepared, runs):
    """The truth of some runs, what was read in them, and the traces of each estimator."""
    truth = trajectory(prepared, runs)
    for label in prepared.scenario.estimators:
        if hasattr(prepared.estimator(label), "smooth"):
            continue
        source = Recorded(prepared.instants, truth)
        traces = followed(prepared, label, runs, source, keep_cov=True)
        assert traces is not None
        assert traces.cov is not None
        yield label, truth, traces


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("rows", [1, 5])
def test_the_rows_of_a_world_are_the_runs_of_a_batch(case, rows, monkeypatch):
    monkeypatch.chdir(ROOT)
    scenario = resolved(case)
    prepared = setup.build(scenario)
    ends = [k + 1 for k, i in enumerate(prepared.instants) if i.tick % prepared.plant.nstep == 0]
    starts = [0, *ends[:-1]]
    for label, truth, traces in simulated(prepared, range(rows)):
        table = {"estimators": {label: scenario.estimators[label]}}
        world = World(setup.build(scenario.model_copy(update=table)), rows)
        world.reset(np.arange(rows), scenario.simulation.seed, range(rows))
        heard, arrived = [], []
        advance = world.simulator.advance

        def listen(event, u, advance=advance, heard=heard):
            out = advance(event, u)
            heard.append(out)
            return out

        world.simulator.advance = listen
        np.testing.assert_array_equal(world.x, truth.x[0])
        for first, last in zip(starts, ends):
            world.step(truth.u[first])
            np.testing.assert_array_equal(world.x, truth.x[last])
            assert world.filter is not None
            np.testing.assert_array_equal(world.filter.estimate, traces.mean[last])
            np.testing.assert_array_equal(world.filter.cov, traces.cov[last])
        arrived = truth.deliveries
        assert len(heard) == len(arrived)
        for ours, theirs in zip(heard, arrived):
            assert [d.channels for d in ours] == [d.channels for d in theirs]
            for a, b in zip(ours, theirs):
                came = np.ones(rows, bool) if b.mask is None else b.mask
                np.testing.assert_array_equal(came, True if a.mask is None else a.mask)
                np.testing.assert_array_equal(a.y[came], b.y[came])


@pytest.mark.parametrize("case", CASES)
def test_an_environment_is_the_run_of_its_seed(case, monkeypatch):
    """Row i of a vector with seed s, and the scalar environment with seed s + i: run 0 of s + i."""
    monkeypatch.chdir(ROOT)
    path, overrides = CASES[case]
    seeds, prepared = (3, 4), setup.build(resolved(case))
    label = next(k for k, v in prepared.scenario.estimators.items() if v.get("type", k) != "rts")
    kwargs = {
        "scenario": path, "estimator": label, "overrides": overrides, "normalize_actions": False,
    }  # fmt: skip
    vector = gym.make_vec("estbench/Scenario-v0", 2, autoreset_mode="Disabled", **kwargs)
    scalars = [gym.make("estbench/Scenario-v0", **kwargs) for _ in seeds]
    runs = []
    for seed in seeds:
        simulation = prepared.scenario.simulation.model_copy(update={"seed": seed})
        scenario = prepared.scenario.model_copy(
            update={
                "simulation": simulation,
                "estimators": {label: prepared.scenario.estimators[label]},
            }
        )
        runs += simulated(setup.build(scenario), [0])
    _, info = vector.reset(seed=seeds[0])
    for row, (env, (_, truth, _)) in enumerate(zip(scalars, runs)):
        _, own = env.reset(seed=seeds[row])
        np.testing.assert_array_equal(own["truth"], truth.x[0, 0])
        np.testing.assert_array_equal(info["truth"][row], truth.x[0, 0])
    limits = ControlRange.of(prepared.plant.model)
    ends = [k + 1 for k, i in enumerate(prepared.instants) if i.tick % prepared.plant.nstep == 0]
    for first, last in zip([0, *ends[:-1]], ends[:12]):
        u = limits.clamp(np.array([truth.u[first, 0] for _, truth, _ in runs]))
        *_, over, _, info = vector.step(u)
        for row, (env, (_, truth, traces)) in enumerate(zip(scalars, runs)):
            *_, own = env.step(u[row])
            for found in (own, {key: value[row] for key, value in info.items()}):
                np.testing.assert_array_equal(found["truth"], truth.x[last, 0])
                np.testing.assert_array_equal(found["estimate"], traces.mean[last, 0])
                np.testing.assert_array_equal(found["error"], traces.error[last, 0])
        if over.any():
            break


@pytest.mark.parametrize("believed", [0.02, 0.0])
def test_an_environment_heeds_the_latency_that_the_filter_believes(believed):
    """The estimates differ from those of a filter that knows the latency, as in a run."""
    late = ["channels.encoder.latency=0.05"]
    belief = [f"filter.channels.encoder.latency={believed}"]
    estimates = []
    for overrides in (late, late + belief):
        env = gym.make("estbench/Pendulum-v0", overrides=overrides)
        env.reset(seed=0)
        estimates.append([env.step(np.ones(1, np.float32))[-1]["estimate"] for _ in range(20)])
    assert np.abs(np.subtract(*estimates)).max() > 1e-3


def test_an_environment_heeds_the_window():
    """A reading that is older than the window is not fused."""
    late = ["channels.encoder.latency=0.03", "channels.encoder.latency_std=0.02"]
    dofs = []
    for overrides in (late, [*late, "filter.window=0.03"]):
        env = gym.make("estbench/Pendulum-v0", overrides=overrides)
        env.reset(seed=0)
        dofs.append(sum(env.step(np.ones(1, np.float32))[-1]["nis_dof"] for _ in range(60)))
    assert dofs[1] < dofs[0] - 5
