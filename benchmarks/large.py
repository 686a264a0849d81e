"""Filters of robots with many joints: `python -m benchmarks.large` (5 minutes).

Gymnasium's humanoid and chains of ball joints, with the sensors that estbench adds where none is
declared, without bound and phases of contact. Least and median CPU ms per run and step of several
rounds in turn, the truth and the records included; of these inside MuJoCo; and over
`mjd_transitionFD` (with Euler's integrator, which it needs) and over the physics step of the same
model, along its undisturbed motion, measured in the same round.
"""

import argparse
import copy
import statistics
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from benchmarks.floor import floor
from estbench.experiment import setup
from estbench.montecarlo import batch
from estbench.robots.library import engine
from estbench.scenario.load import resolve
from estbench.scenario.schema import Scenario

HUMANOID = "gymnasium:envs/mujoco/assets/humanoid.xml"


@dataclass(frozen=True)
class Case:
    """A filter of a robot.

    Attributes:
        joints: ball joints of the chain; 0 for the humanoid.
        kind: the estimator.
        runs, steps: of one round.
    """

    joints: int
    kind: str
    runs: int
    steps: int


CASES = (
    Case(0, "ekf", 1, 200), Case(0, "ekf", 20, 30), Case(9, "ekf", 1, 200), Case(9, "ekf", 20, 30),
    Case(9, "ukf", 1, 100), Case(9, "ukf", 20, 15), Case(16, "ekf", 1, 100),
    Case(16, "ekf", 20, 10), Case(32, "ekf", 1, 30), Case(32, "ekf", 20, 3),
)  # fmt: skip


def chain(joints: int) -> str:
    """MJCF of rods that hang from each other by ball joints with a little damping."""
    rod = (
        '<body pos="0 0 {0}"><joint type="ball" damping="0.01"/>'
        '<geom type="capsule" fromto="0 0 0 0 0 -0.1" size="0.02" contype="0" conaffinity="0"/>'
    )
    rods = "".join(rod.format(-0.1 if i else 0) for i in range(joints))
    return f"<mujoco><worldbody>{rods}{'</body>' * joints}</worldbody></mujoco>"


def prepared(case: Case, folder: Path) -> setup.Setup:
    """The experiment; the file of a chain is written to the folder."""
    path = HUMANOID
    if case.joints:
        path = str(folder / f"chain{case.joints}.xml")
        Path(path).write_text(chain(case.joints), encoding="utf-8")
    robot = Scenario.model_validate({"name": "large", "model": {"path": path}})
    off = ["bound=false", "contact.phases=false"]
    ready = setup.build(resolve(robot, [case.kind], runs=case.runs, overrides=off))
    end = f"simulation.duration={case.steps * ready.plant.period:g}"
    return setup.build(resolve(ready.scenario, [case.kind], overrides=[end]))


def ours(ready: setup.Setup) -> tuple[float, float]:
    """CPU s of all runs as one batch, and those inside MuJoCo."""
    began = time.process_time()
    with floor(time.process_time) as inside:
        batch.run_batch(ready, range(ready.scenario.simulation.runs), "summary")
    return time.process_time() - began, inside.seconds


def plain(ready: setup.Setup, steps: int) -> tuple[float, float]:
    """CPU s of `mjd_transitionFD` and of `mj_step`, each per physics step from the start on."""
    model, n = ready.plant.model, ready.space.n
    euler = copy.copy(model)
    euler.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    data, A = mujoco.MjData(model), np.empty((n, n))
    data.qpos[:] = ready.mean[: model.nq]
    spent = np.zeros(2)
    for _ in range(steps):
        times = [time.process_time()]
        mujoco.mjd_transitionFD(euler, data, 1e-6, False, A, None, None, None)
        times.append(time.process_time())
        mujoco.mj_step(model, data)
        times.append(time.process_time())
        spent += np.diff(times)
    return tuple(spent / steps)


def row(case: Case, folder: Path, repeat: int) -> str:
    """A line of the table."""
    ready = prepared(case, folder)
    found = []
    with engine():
        ours(ready)
        for _ in range(repeat):
            whole, inside = (1e3 * s / (case.runs * case.steps) for s in ours(ready))
            found.append((whole, inside, *(1e3 * s for s in plain(ready, case.steps))))
    whole, inside, jacobian, step = np.array(found).T
    robot = f"{case.joints} ball joints" if case.joints else "humanoid"
    m = sum(space.n for space in ready.channel_spaces.values())
    cells = (
        f"{case.kind}, {robot}, {case.runs} x {case.steps}", f"{ready.space.n}", f"{m}",
        f"{whole.min():.2f}", f"{statistics.median(whole):.2f}", f"{np.median(inside):.2f}",
        f"{np.median(whole - inside):.2f}", f"{np.median(whole / jacobian):.1f}",
        f"{np.median(whole / step):.0f}",
    )  # fmt: skip
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--only", type=int, nargs="*", help="counts of ball joints; 0: humanoid")
    args = parser.parse_args()
    print(
        "| | n | readings | ms, least | median | in MuJoCo | outside "
        "| over `mjd_transitionFD` | over `mj_step` |"
    )
    print("|---" + 8 * "|---:" + "|")
    with tempfile.TemporaryDirectory() as folder:
        for case in CASES:
            if args.only is None or case.joints in args.only:
                print(row(case, Path(folder), args.repeat), flush=True)


if __name__ == "__main__":
    main()
