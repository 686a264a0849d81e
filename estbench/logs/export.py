"""Simulated runs as logs (CSV, rosbags, trajectories), and the scenario that replays them."""

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from estbench.errors import LogError
from estbench.experiment.prepared import Setup
from estbench.experiment.recording import recorded
from estbench.experiment.setup import build
from estbench.logs import write_bag
from estbench.logs.trajectory import Poses, write_tum
from estbench.logs.truth import bodies, true_states
from estbench.robots.layout import control_names, state_names
from estbench.scenario.load import load
from estbench.scenario.log import (
    LogChannel,
    LogColumns,
    LogSection,
    TruthSection,
)
from estbench.sensors.delivery import divided
from estbench.shapes import Array
from estbench.simulation.sources import Trajectory
from estbench.store import locks
from estbench.store.metadata import STORE
from estbench.store.reader import open_results

SCENARIO = "scenario.toml"


FORMATS = ("csv", "mcap", "tum")


def export(
    source: str | Path,
    folder: str | Path,
    runs: Sequence[int] | None = None,
    form: str = "csv",
) -> list[Path]:
    """Write runs of a scenario, with the numbers that `estbench run` has, as logs.

    Columns of CSV: `time` s; the readings of each channel, empty where none arrives, and
    `CHANNEL.taken` where it is late; the controls, held to the next row; the true state. All
    numbers have the digits that give them back. `scenario.toml` beside them has the section
    `[log]`. A bag has these as topics (`write_bag`), with time stamps in whole ns. TUM files have
    the true poses of free joints, and the estimated ones of a results folder with traces.

    Args:
        source: a results folder, or a scenario.
        folder: to be made.
        runs: their numbers; default all.
        form: one of `FORMATS`.

    Returns:
        The files, or the folders of bags.

    Raises:
        LogError: the folder exists, the controller sees the estimate, or the runs are a replay.
        EstbenchError: as `experiment.setup.build`.
    """
    target = Path(folder)
    if form not in FORMATS:
        raise LogError(f"--format is '{form}'; use one of {', '.join(FORMATS)}")
    if target.exists():
        raise LogError(f"--out {folder} exists; choose another folder")
    scenario = load(source)
    if scenario.control.observe == "estimate":
        raise LogError(
            "control.observe is 'estimate': each estimator has a truth of its own; export a "
            "scenario whose truth is the same for all"
        )
    if (Path(source) / STORE).is_dir() and "log" in open_results(source).attrs:
        raise LogError(f"{source} is a replay of a log, which is one already; its TUM files are in "
                       f"{Path(source) / 'trajectories'}")  # fmt: skip
    prepared = build(scenario)
    every = range(scenario.simulation.runs)
    numbers = list(every if runs is None else runs)
    unknown = [run for run in numbers if run not in every]
    if unknown:
        raise LogError(f"run {unknown[0]} is not one of the {len(every)} runs, from 0")
    found = recorded(prepared, numbers)
    if found is None:
        raise LogError("the runs were stopped")
    draft = locks.draft(target)
    with locks.building(draft):
        write = {"csv": _csv, "mcap": _mcap, "tum": _tum}[form]
        names = write(prepared, found[0], numbers, draft, Path(source))
        draft.rename(target)
    return [target / name for name in names]


def _csv(
    prepared: Setup, truth: Trajectory, numbers: Sequence[int], folder: Path, source: Path
) -> list[str]:
    late, names = _late(prepared), []
    for row, run in enumerate(numbers):
        names.append(f"run_{run}.csv")
        with (folder / names[-1]).open("w", newline="", encoding="utf-8") as out:
            csv.writer(out).writerows(_rows(prepared, truth, row, late))
    _write_scenario(prepared, section(prepared, late), folder)
    return names


def _mcap(
    prepared: Setup, truth: Trajectory, numbers: Sequence[int], folder: Path, source: Path
) -> list[str]:
    names = [f"run_{run}" for run in numbers]
    for row, name in enumerate(names):
        write_bag.write(prepared, truth, row, folder / name)
    _write_scenario(prepared, write_bag.section(prepared), folder)
    return names


def _tum(
    prepared: Setup, truth: Trajectory, numbers: Sequence[int], folder: Path, source: Path
) -> list[str]:
    free = bodies(prepared.space)
    if not free:
        raise LogError("the robot has no free joint, so no poses of a base; use --format csv")
    estimates: dict[str, Array] = {}
    if (source / STORE).is_dir():
        tree = open_results(source)
        for label in prepared.scenario.estimators:
            if "estimate" in tree[label]:
                estimates[label] = np.asarray(tree[label]["estimate"])
    names = []
    for row, run in enumerate(numbers):
        of_run = {"truth": truth.x[:, row], **{k: x[run] for k, x in estimates.items()}}
        for joint, (position, turn, _) in free.items():
            for label, x in of_run.items():
                known = np.isfinite(x).all(axis=1)
                names.append(f"run_{run}.{joint}.{label}.tum")
                poses = Poses(prepared.times[known], x[known, position], x[known, turn])
                write_tum(folder / names[-1], poses)
    return names


def _write_scenario(prepared: Setup, log: LogSection, folder: Path) -> None:
    changed = prepared.scenario.model_copy(update={"log": log})
    (folder / SCENARIO).write_text(changed.to_toml(), encoding="utf-8")


def section(prepared: Setup, late: Sequence[str]) -> LogSection:
    """The section `[log]` of the files."""
    channels = {
        c.name: LogChannel(
            columns=_columns(c.name, c.space.nx),
            taken=f"{c.name}.taken" if c.name in late else None,
        )
        for c in prepared.channels
    }
    controls = {
        name: LogColumns(columns=[f"u.{name}"]) for name in control_names(prepared.plant.model)
    }
    return LogSection(
        time="time", instants="all", channels=channels, controls=controls,
        truth=TruthSection(states=true_states(prepared.space, "x.")),
    )  # fmt: skip


def _late(prepared: Setup) -> tuple[str, ...]:
    """The channels whose readings may arrive after they were taken."""
    return tuple(c.name for c in prepared.channels if c.timing.latency or c.timing.latency_std)


def _columns(name: str, width: int) -> list[str]:
    return [name] if width == 1 else [f"{name}.{i}" for i in range(width)]


def _rows(prepared: Setup, truth: Trajectory, run: int, late: Sequence[str]) -> Iterator[list[str]]:
    """The headings and the rows of one run."""
    widths = {c.name: c.space.nx for c in prepared.channels}
    headings = [column for name, width in widths.items() for column in _columns(name, width)]
    taken = [f"{name}.taken" for name in late]
    controls = [f"u.{name}" for name in control_names(prepared.plant.model)]
    states = [f"x.{name}" for name in state_names(prepared.space)]
    yield ["time", *headings, *taken, *controls, *states]
    timestep = float(prepared.plant.model.opt.timestep)
    times = [0.0, *(i.end for i in prepared.instants)]
    for k, t in enumerate(times):
        u = truth.u[min(k, len(truth.u) - 1), run]
        layers: list[dict[str, tuple[Array, float]]] = [{}]
        for part in divided(truth.deliveries[k - 1]) if k else ():
            (name,) = part.channels
            if part.mask is None or part.mask[run]:
                when = t if part.taken == prepared.instants[k - 1].tick else part.taken * timestep
                free = next((layer for layer in layers if name not in layer), None)
                if free is None:
                    layers.append(free := {})
                free[name] = part.y[run], when
        for layer in layers:
            cells = [cell for name, width in widths.items() for cell in _cells(layer, name, width)]
            stamps = [repr(layer[name][1]) if name in layer else "" for name in late]
            yield [repr(t), *cells, *stamps, *map(_text, u), *map(_text, truth.x[k, run])]


def _cells(layer: dict[str, tuple[Array, float]], name: str, width: int) -> list[str]:
    return list(map(_text, layer[name][0])) if name in layer else [""] * width


def _text(value: float) -> str:
    """A number with all its digits; empty where it is not finite."""
    return repr(float(value)) if np.isfinite(value) else ""
