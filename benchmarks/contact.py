"""Filters on robots with feet on the ground: `python -m benchmarks.contact`.

Five of Gymnasium's robots, shaken by random torques: encoders and a pose fix, an EKF, a UKF and
the filters for contact on the same truth and readings. Prints the figures of docs/contact.md:
NEES/n with its 95% interval, NIS/m, the RMSE of positions and velocities over the UKF's (geometric
mean over the coordinates), the cost, and the verdict's reason. `--only` takes variants of their
settings too.
"""

import argparse
import tomllib
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.contact_conditions import CONDITIONS
from estbench.montecarlo import run as experiment
from estbench.montecarlo.results import Results
from estbench.robots import mjcf
from estbench.scenario.schema import Scenario
from estbench.tables import phases, writers
from estbench.tables.quantity import quantity

EXAMPLES = Path(__file__).parents[1] / "examples" / "gymnasium"
LIKE = {"walker2d": "hopper", "humanoid": "ant"}
"""Robots without an example of their own -> the one that they are sensed and shaken like."""
ROBOTS = ("hopper", "half_cheetah", "ant", "walker2d", "humanoid")
MAIN = ("ekf", "ukf", "rotated_ukf", "diplf")
OMEGA = "benchmarks.contact_omega:OmegaUKF"
VARIANTS: dict[str, dict[str, Any]] = {
    **{name: {} for name in MAIN},
    "w0": {"type": "rotated_ukf", "centre_weight": 0.0},
    "w0.5": {"type": "rotated_ukf", "centre_weight": 0.5},
    "omega0": {"type": "rotated_ukf", "centre_weight": 0.0, "omega": 0.0},
    "omega2": {"type": "rotated_ukf", "centre_weight": 0.0, "omega": 2.0},
    "K4_omega0": {"type": "rotated_ukf", "centre_weight": 0.0, "omega": 0.0, "rotations": 4},
    "only_omega0": {"type": "rotated_ukf", "omega": 0.0},
    "only_omega0.5": {"type": "rotated_ukf", "omega": 0.5},
    "only_K4": {"type": "rotated_ukf", "rotations": 4},
    "K3_omega0.2": {"type": "rotated_ukf", "rotations": 3, "omega": 0.2},
    "shrunk0.3_omega0": {"type": OMEGA, "shrinkage": 0.3, "omega": 0.0},
    "shrunk0.3_omega0.1": {"type": OMEGA, "shrinkage": 0.3, "omega": 0.1},
    "concentrated_omega2": {"type": OMEGA, "concentrated": True, "omega": 2.0},
    "concentrated_omega4": {"type": OMEGA, "concentrated": True, "omega": 4.0},
    "averaged_omega0.2": {"type": OMEGA, "rate": 0.3, "omega": 0.2},
    "averaged_omega0.4": {"type": OMEGA, "rate": 0.3, "omega": 0.4},
    "iplf": {"base": "rotated_ukf"},
    "urts": {},
    "ipls": {"base": "rotated_ukf", "iterations": 3},
}
"""Label -> settings; those of one type show what its settings do, `only_` one of them alone."""


def scenario(robot: str) -> dict[str, Any]:
    """The example of a robot, or one made from the example of another robot."""
    data = tomllib.loads((EXAMPLES / f"{LIKE.get(robot, robot)}.toml").read_text(encoding="utf-8"))
    if robot in LIKE:
        path = f"gymnasium:envs/mujoco/assets/{robot}.xml"
        data["name"], data["model"]["path"] = robot, path
        del data["description"]
        data["channels"] = channels(data["channels"], path)
    return data


def channels(known: dict[str, Any], path: str) -> dict[str, Any]:
    """The channels of the root, and an encoder on each joint of another robot."""
    names = [joint.name for joint in mjcf.read(path).joints if not joint.name.startswith("root")]
    encoder = next(c for c in known.values() if not c["add"]["object"].startswith("root"))
    encoders = {
        f"{name}_encoder": {**encoder, "add": {"type": "jointpos", "object": name}}
        for name in names
    }
    root = {
        k: c for k, c in known.items() if c["add"]["object"] in ("rootx", "rootz", "rooty", "torso")
    }
    return encoders | root


def rows(results: Results) -> list[str]:
    """Lines of a Markdown table."""
    names = np.array(results.names)
    speeds = np.char.endswith(names, ".vel") | np.char.startswith(names, "root.v")
    speeds |= np.char.startswith(names, "root.w")
    peer = np.array([i.value for i in results["ukf"].rmse])
    lines = []
    for s in results.summaries:
        ratio = np.log(np.array([i.value for i in s.rmse]) / peer)
        over = [f"{np.exp(ratio[which].mean()):.2f}" for which in (~speeds, speeds)]
        cells = [f"`{s.label}`", str(s.verdict), quantity(s.anees), quantity(s.anis)]
        cells += [f"{s.diverged:.0%}", *over, f"{s.cost:.0f}"]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--duration", type=float, default=2.0, help="s")
    parser.add_argument("--seeds", nargs="*", type=int, default=[0])
    parser.add_argument("--robots", nargs="*", default=ROBOTS, choices=ROBOTS)
    parser.add_argument("--only", nargs="*", default=list(MAIN), choices=list(VARIANTS))
    parser.add_argument(
        "--conditions",
        nargs="*",
        default=[next(iter(CONDITIONS))],
        choices=CONDITIONS,
        help="of the noise, the sensors and the filter's model",
    )
    parser.add_argument("--phases", action="store_true", help="print NEES/n by phase too")
    parser.add_argument("--set", nargs="*", default=[], help="settings of the scenario, KEY=VALUE")
    args = parser.parse_args()
    head = ["estimator", "verdict", "NEES/n", "NIS/m", "diverged", "positions", "velocities", "µs"]
    for robot, condition in product(args.robots, args.conditions):
        for seed in args.seeds:
            data = CONDITIONS[condition](scenario(robot))
            data |= {"estimators": {k: VARIANTS[k] for k in ("ukf", *args.only)}, "bound": False}
            results = experiment.run(
                Scenario.model_validate(data), runs=args.runs, seed=seed, duration=args.duration,
                overrides=args.set, keep="summary",
            )  # fmt: skip
            what = f"{robot}, {condition}, seed {seed}"
            print(f"\n## {what}, {args.runs} runs of {args.duration:g} s")
            print("| " + " | ".join(head) + " |\n" + "|---" * len(head) + "|")
            print("\n".join(rows(results)), flush=True)
            print(
                "".join(f"\n`{s.label}`: {s.reason}" for s in results.summaries if s.reason),
                flush=True,
            )
            found = phases.table((s.label, results.phases(s.label)) for s in results.summaries)
            if args.phases and found is not None:
                print(writers.markdown([found]), flush=True)


if __name__ == "__main__":
    main()
