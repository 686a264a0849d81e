"""What imperfect sensors cost: `python -m benchmarks.sensors [runs]`, default 1000 runs.

1. Imperfections against white noise only: runs of the cart-pole, the same process, one thread,
   processor time, the least of some repetitions. The target, at most 1.3, is for all together.
2. Exact handling of a reading that is d steps late: predicts beyond those of readings on time.
   Target: about d.

Encoders have one axis and cannot be misaligned, so that a gyro joins them. Late readings are fused
naively in 1, as going back is what 2 counts. Jitter needs physics steps shorter than a reading's
period; it has a white-noise row of its own, and each of its instants costs the filter a predict,
whatever the sensors.
"""

import sys
import time
from collections.abc import Sequence

import numpy as np

from estbench.estimators.ekf import EKF
from estbench.experiment import recording, setup
from estbench.inference.event_loop import run_filter
from estbench.montecarlo import run as experiment
from estbench.montecarlo.batch import traced
from estbench.robots.library import engine
from estbench.simulation.sources import Recorded

EVERYTHING = (
    "bias=0.01", "bias_walk=0.001", "drift=0.01", "scale_factor=0.001", "quantization=0.001",
    "cutoff=50.0", "deadband=0.0005", "outlier_probability=0.01", "student_dof=5", "dropout=0.1",
    "dropout_length=3", "stuck=0.001", "schedule=[[2.5, 1.0], [5.0, 1.5]]",
)  # fmt: skip
ENCODERS = ("cart_encoder", "pole_encoder")
GYRO = (*ENCODERS, "gyro")
RUNS, BATCH, REPEATS = 1000, 250, 3
DELAYS = (1, 2, 4, 8, 16)


def on(channels: Sequence[str], *settings: str) -> tuple[str, ...]:
    """Overrides that give every channel the settings."""
    return tuple(f"channels.{c}.{setting}" for c in channels for setting in settings)


SENSORS = (f"sensors={list(GYRO)}".replace("'", '"'),)
SHORT = (*SENSORS, "model.timestep=0.002", "model.frame_skip=5", *on(GYRO, "rate=100"))
MISALIGNED = (*on(GYRO, *EVERYTHING), *on(["gyro"], "misalignment=0.01"))
LATE = (*MISALIGNED, "filter.delays=naive", *on(GYRO, "latency=0.03"))
RANDOM = (*LATE, *on(GYRO, "latency_std=0.005"))
CASES = {
    "encoders: all but misalignment and lateness": ((), on(ENCODERS, *EVERYTHING)),
    "and a gyro: all but lateness": (SENSORS, MISALIGNED),
    "and a gyro: and a fixed latency, naive": (SENSORS, LATE),
    "and a gyro: and a random latency, naive": (SENSORS, RANDOM),
    "and a gyro, 2 ms steps: all, jitter too, naive": (
        SHORT, (*RANDOM, *on(GYRO, "jitter=0.004")),
    ),
}  # fmt: skip
"""Name -> overrides of both, and those of the imperfect sensors."""


def seconds(overrides: Sequence[str], estimators: Sequence[str], count: int) -> float:
    """Processor time of truth, sensors and estimators on all runs."""
    prepared = setup.build(experiment.resolve("cartpole", estimators, overrides=overrides))
    began = time.process_time()
    with engine():
        for first in range(0, count, BATCH):
            runs = range(first, min(first + BATCH, count))
            if estimators:
                for _ in traced(prepared, runs):
                    pass
            else:
                recording.trajectory(prepared, runs)
    return time.process_time() - began


def imperfections(count: int) -> None:
    """The ratio of everything to white noise only."""
    print(f"{count} runs of cartpole, 5 s each; the best of {REPEATS}, s of one core")
    print(f"{'sensors':48}{'estimators':12}{'white':>8}{'all':>8}{'ratio':>8}")
    for case, (common, flaws) in CASES.items():
        for estimators in (("ekf", "ukf"), ("ekf",), ()):
            times = np.array([
                [seconds((*common, *more), estimators, count) for more in ((), flaws)]
                for _ in range(REPEATS)
            ]).min(axis=0)  # fmt: skip
            name = ", ".join(estimators) or "truth only"
            ratio = times[1] / times[0]
            print(f"{case:48}{name:12}{times[0]:8.2f}{times[1]:8.2f}{ratio:8.2f}", flush=True)


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
            trajectory = recording.trajectory(prepared, runs)
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
    imperfections(int(sys.argv[1]) if len(sys.argv) > 1 else RUNS)
    delays()
