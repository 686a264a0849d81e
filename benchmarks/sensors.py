"""What imperfect sensors cost: `python -m benchmarks.sensors`.

1. Every imperfection at once (but latency and jitter) against white noise only: 1000 runs of the
   cart-pole, the same process, one thread, processor time. Target: at most 1.3.
2. Exact handling of a reading that is d steps late: predicts beyond those of readings on time.
   Target: about d.

Latency and jitter are left out of 1: what they cost is the filter's going back, which 2 counts.
Misalignment is, as an encoder has one axis.
"""

import time
from collections.abc import Sequence

import numpy as np

from estbench import experiment, setup
from estbench.estimators.ekf import EKF
from estbench.filtering import Recorded, run_filter
from estbench.models.rows import engine
from estbench.truth import simulate

EVERYTHING = (
    "bias=0.01", "bias_walk=0.001", "drift=0.01", "scale_factor=0.001", "quantization=0.001",
    "cutoff=50.0", "deadband=0.0005", "outlier_probability=0.01", "student_dof=5", "dropout=0.1",
    "dropout_length=3", "stuck=0.001", "schedule=[[2.5, 1.0], [5.0, 1.5]]",
)  # fmt: skip
CHANNELS = ("cart_encoder", "pole_encoder")
RUNS, BATCH, REPEATS = 1000, 250, 3
DELAYS = (1, 2, 4, 8, 16)


def seconds(overrides: Sequence[str], estimators: Sequence[str]) -> float:
    """Processor time of truth, sensors and estimators on all runs."""
    prepared = setup.build(experiment.resolve("cartpole", estimators, overrides=overrides))
    began = time.process_time()
    with engine():
        for first in range(0, RUNS, BATCH):
            runs = range(first, first + BATCH)
            if estimators:
                for _ in experiment.traced(prepared, runs):
                    pass
            else:
                period = prepared.plant.period
                simulate(prepared.simulator(runs), prepared.controller(runs), period)
    return time.process_time() - began


def imperfections() -> None:
    """The ratio of everything to white noise only."""
    everything = [f"channels.{c}.{setting}" for c in CHANNELS for setting in EVERYTHING]
    print(f"{RUNS} runs of cartpole, 5 s each; the best of {REPEATS}, s of one core")
    print(f"{'estimators':12}{'white noise':>14}{'everything':>14}{'ratio':>8}")
    for estimators in (("ekf", "ukf"), ("ekf",), ()):
        times = np.array([
            [seconds(settings, estimators) for settings in ((), everything)] for _ in range(REPEATS)
        ]).min(axis=0)  # fmt: skip
        name = ", ".join(estimators) or "truth only"
        print(f"{name:12}{times[0]:14.2f}{times[1]:14.2f}{times[1] / times[0]:8.2f}")


class Counting(EKF):
    """An EKF that counts its predictions."""

    predicts = 0

    def predict(self, belief, u, t, dt):
        type(self).predicts += 1
        return super().predict(belief, u, t, dt)


def delays() -> None:
    """Extra predicts and time of late readings."""
    print("\nquadrotor, position fix at 10 Hz, d steps of 5 ms late, 100 runs together")
    print(f"{'d':>3}{'late arrivals':>15}{'extra predicts':>16}{'per arrival':>13}{'time':>8}")
    base = None
    for d in (0, *DELAYS):
        overrides = ["channels.position.rate=10", f"channels.position.latency={0.005 * d}"]
        prepared = setup.build(experiment.resolve("quadrotor", ["ekf"], overrides=overrides))
        runs = range(100)
        prior = np.tile(prepared.mean, (100, 1)), np.tile(prepared.cov, (100, 1, 1))
        with engine():
            period = prepared.plant.period
            trajectory = simulate(prepared.simulator(runs), prepared.controller(runs), period)
            Counting.predicts = 0
            began = time.process_time()
            run_filter(
                Counting(prepared.model()), prepared.space, prior,
                Recorded(prepared.instants, trajectory), prepared.channel_spaces,
                delays=prepared.delays("ekf"),
            )  # fmt: skip
            spent = time.process_time() - began
        extra = Counting.predicts - len(prepared.instants)
        late = sum(x.channel == "position" and d > 0 for a in trajectory.deliveries for x in a)
        base = base or spent
        each = f"{extra / late:.2f}" if late else "-"
        print(f"{d:3}{late:15}{extra:16}{each:>13}{spent / base:8.2f}")


if __name__ == "__main__":
    imperfections()
    delays()
