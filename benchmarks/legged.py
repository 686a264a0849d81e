"""Filters on walking robots: `python -m benchmarks.legged`.

The bundled quadruped and biped stand, then walk: IMU, encoders and foot contact, no position fix.
Filters of the whole dynamics (`ekf`, `ukf`, `rotated_ukf`, and `symmetric`, which is the last with
`symmetries = true`) and of IMU and leg kinematics
(`contact_ekf`, `contact_inekf`, and GTSAM's where it is installed) on the same truth and readings.
Prints the table of docs/contact.md: verdict, NEES/n of the whole state and of the base alone (pose
and velocity, 9 coordinates), the RMSE of the velocity of the base, the error of position and yaw at
the end, which no sensor shows, and the cost; below it the reason of each verdict.
"""

import argparse

import numpy as np

from estbench.consistency import records
from estbench.consistency.intervals import positive_mean_interval
from estbench.consistency.summary import summarize
from estbench.experiment.setup import build
from estbench.inference.traces import Traces
from estbench.montecarlo.batch import traced
from estbench.scenario.load import load
from estbench.spaces.linalg import quadratic_form
from estbench.tables.quantity import quantity

ROBOTS = ("quadruped", "biped")
FILTERS = ("ekf", "ukf", "rotated_ukf", "symmetric", "contact_ekf", "contact_inekf")
SETTINGS = {"symmetric": {"type": "rotated_ukf", "symmetries": True}}
"""Label -> settings, of the labels that are no names of estimators."""
HEAD = (
    "estimator", "verdict", "NEES/n", "NIS/m", "NEES/9 of the base", "velocity, mm/s",
    "position at the end, mm", "yaw at the end, mrad", "µs per step",
)  # fmt: skip


def base_row(traces: Traces, nv: int) -> list[str]:
    """NEES/9 of the base, RMSE of its velocity, and RMS errors of position and yaw at the end."""
    where = np.r_[0:6, nv : nv + 3]
    error, cov = traces.error[1:, :, where], traces.cov
    assert cov is not None
    nees = quadratic_form(cov[1:, :, where[:, None], where], error) / len(where)
    speed = np.sqrt(np.mean(np.sum(error[..., 6:] ** 2, axis=-1)))
    place = np.sqrt(np.mean(np.sum(error[-1, :, :2] ** 2, axis=-1)))
    yaw = np.sqrt(np.mean(error[-1, :, 5] ** 2))
    each = positive_mean_interval(nees.mean(axis=0))
    return [quantity(each), *(f"{1e3 * value:.1f}" for value in (speed, place, yaw))]


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--duration", type=float, help="s; default the scenario's")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--robots", nargs="*", default=ROBOTS, choices=ROBOTS)
    parser.add_argument("--only", nargs="*", default=FILTERS, help="names of estimators")
    parser.add_argument("--set", nargs="*", default=[], help="settings of the scenario, KEY=VALUE")
    args = parser.parse_args()
    for robot in args.robots:
        length = [] if args.duration is None else [f"simulation.duration={args.duration}"]
        scenario = load(robot, [f"simulation.seed={args.seed}", "bound=false", *length, *args.set])
        labels = {k: scenario.estimators.get(k, SETTINGS.get(k, {})) for k in args.only}
        prepared = build(scenario.model_copy(update={"estimators": labels}))
        section, runs, nv = scenario.consistency, range(args.runs), prepared.plant.model.nv
        seconds = prepared.times[-1]
        print(f"\n## {robot}, seed {args.seed}, {args.runs} runs of {seconds:g} s")
        print("| " + " | ".join(HEAD) + " |\n" + "|---" * len(HEAD) + "|", flush=True)
        reasons: list[str] = []
        for label, traces in traced(prepared, runs, keep_cov=True):
            assert traces is not None
            record = records.reduce(traces, prepared.times, section, "summary")
            s = summarize(
                label, record, runs, prepared.times, section, prepared.space.names,
                tuple(prepared.channel_spaces),
            )  # fmt: skip
            cells = [f"`{label}`", str(s.verdict), quantity(s.anees), quantity(s.anis)]
            cells += [*base_row(traces, nv), f"{s.cost:.0f}"]
            print("| " + " | ".join(cells) + " |", flush=True)
            reasons += [f"`{label}`: {s.reason}"] if s.reason else []
        print("\n" + "\n".join(reasons), flush=True)


if __name__ == "__main__":
    main()
