"""Simulated runs as logs: one CSV file per run, and the scenario that replays them."""

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from estbench.errors import LogError
from estbench.experiment.prepared import Setup
from estbench.experiment.recording import recorded
from estbench.experiment.setup import build
from estbench.robots.layout import control_names, state_names
from estbench.scenario.load import load
from estbench.scenario.log import (
    LogChannel,
    LogColumns,
    LogSection,
    TruthColumns,
    TruthSection,
)
from estbench.sensors.sampling import divided
from estbench.shapes import Array
from estbench.simulation.sources import Trajectory

SCENARIO = "scenario.toml"


def export(source: str | Path, folder: str | Path, runs: Sequence[int] | None = None) -> list[Path]:
    """Write runs of a scenario, with the numbers that `estbench run` has, as CSV files.

    Columns: `time` s; the readings of each channel, empty where none arrives, and `CHANNEL.taken`
    where it is late; the controls, held to the next row; the true state. All numbers have the
    digits that give them back. `scenario.toml` beside them has the section `[log]`.

    Args:
        source: a results folder, or a scenario.
        folder: to be made.
        runs: their numbers; default all.

    Returns:
        The files of the runs.

    Raises:
        LogError: the folder exists, or the controller sees the estimate.
        EstbenchError: as `experiment.setup.build`.
    """
    target = Path(folder)
    if target.exists():
        raise LogError(f"--out {folder} exists; choose another folder")
    scenario = load(source)
    if scenario.control.observe == "estimate":
        raise LogError(
            "control.observe is 'estimate': each estimator has a truth of its own; export a "
            "scenario whose truth is the same for all"
        )
    prepared = build(scenario)
    every = range(scenario.simulation.runs)
    numbers = list(every if runs is None else runs)
    unknown = [run for run in numbers if run not in every]
    if unknown:
        raise LogError(f"run {unknown[0]} is not one of the {len(every)} runs, from 0")
    found = recorded(prepared, numbers)
    if found is None:
        raise LogError("the runs were stopped")
    late = _late(prepared)
    target.mkdir(parents=True)
    files = []
    for row, run in enumerate(numbers):
        file = target / f"run_{run}.csv"
        with file.open("w", newline="", encoding="utf-8") as out:
            csv.writer(out).writerows(_rows(prepared, found[0], row, late))
        files.append(file)
    changed = scenario.model_copy(update={"log": section(prepared, late)})
    (target / SCENARIO).write_text(changed.to_toml(), encoding="utf-8")
    return files


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
    numbers = state_names(prepared.space)
    turns = [q for q, _ in prepared.space.quaternions.tolist()]
    states = {
        name.removesuffix(".qw") + ".rotation" if i in turns else name: TruthColumns(
            columns=[f"x.{n}" for n in numbers[i : i + 4 if i in turns else i + 1]]
        )
        for i, name in enumerate(numbers)
        if not any(q < i < q + 4 for q in turns)
    }
    return LogSection(
        time="time", instants="all", channels=channels, controls=controls,
        truth=TruthSection(states=states),
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
