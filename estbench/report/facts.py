"""Text and tables of the report: verdicts, the scenario, the diverged runs."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estbench.analysis import explanations
from estbench.analysis.finding import Finding
from estbench.analysis.stored import Stored
from estbench.consistency.verdict import Verdict
from estbench.errors import AnalysisError, EstbenchError
from estbench.estimators.beliefs import Fault
from estbench.experiment import setup
from estbench.report.figures.data import Steps
from estbench.report.figures.traces import TraceStatistics
from estbench.report.sources import Entry
from estbench.robots import layout, mjcf
from estbench.scenario.reference import seen
from estbench.sensors.description import HEADINGS, ChannelDescription, describe
from estbench.store.versions import known
from estbench.tables import units
from estbench.tables.quantity import quantity

DIVERGED_ROWS = 100
"""Diverged runs listed of one estimator."""


@dataclass(frozen=True)
class Facts:
    """The scenario of one source.

    Attributes:
        title: of the source.
        description: of the scenario, one line.
        rows: pairs of name and value.
        headings: headings of `sensors`.
        sensors: one row per channel; empty without the robot.
        noise: rows of coordinate, initial σ, process noise.
        differences: how the filter's model differs from the truth, one line each.
        toml: the scenario as it was run.
        problem: why the robot could not be built, or "".
        log: whether it is a replay: the filter's model is then compared with no other.
    """

    title: str
    description: str
    rows: tuple[tuple[str, str], ...]
    headings: tuple[str, ...]
    sensors: tuple[tuple[str, ...], ...]
    noise: tuple[tuple[str, ...], ...]
    differences: tuple[str, ...]
    toml: str
    problem: str
    log: bool


def verdict(entry: Entry, steps: Steps) -> str:
    """The verdict on one estimator in one or two sentences."""
    s = entry.summary
    good = s.runs - round(s.diverged * s.runs)
    rows = "runs" if entry.source.log is None else "parts of the log"
    what = f"NEES/n is {quantity(s.anees)}" if s.truth else f"NIS/m is {quantity(s.anis)}"
    text = f"{what} over {good} {rows}" if good else f"No {rows[:-1]} is left"
    if s.verdict is Verdict.CONSISTENT:
        text += (
            ": its errors are as large as its covariance says"
            if s.truth
            else ": its innovations are as large as their covariance says"
        )
    elif (
        s.verdict in (Verdict.OVERCONFIDENT, Verdict.CONSERVATIVE)
        and s.truth
        and (1 not in s.anees)
    ):
        size = "larger" if s.anees.value > 1 else "smaller"
        # Not RMSE/σ of one coordinate: with correlated coordinates each may be nearer to 1.
        root = f"{math.sqrt(max(s.anees.value, 0)):.3g}"
        text += (
            f": its errors are {size} than its covariance says, {root} σ in root mean square along "
            "the covariance's own axes"
        )
    text += "."
    if s.reason:
        text += f" {s.reason[0].upper()}{s.reason[1:]}."
    if math.isfinite(steps.outside):
        text += (
            f" The mean over runs is outside its {1 - steps.expected:.0%} band at "
            f"{steps.outside:.1%} of the steps ({steps.expected:.0%} expected)"
        )
        start, end, share = steps.worst_window()
        if steps.outside > 2 * steps.expected and share > 1.5 * steps.outside:
            text += f", most of all from t = {start:g} to {end:g} s ({share:.0%})"
        text += "."
    return text


def causes(entry: Entry) -> tuple[Finding, ...]:
    """Why the verdict is not *consistent*, and what usually helps.

    None for a consistent estimator, and none from a store of an earlier version, which lacks the
    evidence; the reason in the verdict then says so.
    """
    if entry.summary.verdict is Verdict.CONSISTENT:
        return ()
    try:
        return explanations.of(entry.source, entry.label).findings
    except AnalysisError:
        return ()


def facts(source: Stored) -> Facts:
    """Facts about the scenario; those that need the robot are empty if its file is missing."""
    scenario, attrs = source.scenario, source.attrs
    simulation, log = scenario.simulation, source.log
    count = f"{len(source.runs)}"
    if len(source.runs) < source.total:
        count += f" finished of {source.total}"
    of_log = (
        []
        if log is None
        else [
            ("log", ", ".join(log["files"])),
            ("held out", ", ".join(log["held_out"]) or "no channel"),
            ("truth", "known, at least in part" if log["truth"] else "not known"),
        ]
    )
    rows = [
        *of_log,
        ("runs", count),
        ("duration", f"{source.times[-1]:g} s in {source.instants} instants"),
        *(
            []
            if log
            else [
                ("seed", f"{attrs.get('seed', simulation.seed)}"),
                ("control", f"{scenario.control.kind}, seeing {seen(scenario)}"),
            ]
        ),
        ("estimators", ", ".join(attrs["estimators"])),
        ("robot", scenario.model.path),
        *(
            ("continued with" if i else "versions", ", ".join(f"{k} {v}" for k, v in v.items()))
            for i, v in enumerate(known(attrs))
        ),
    ]
    channels: tuple[ChannelDescription, ...] = ()
    noise: tuple[tuple[str, ...], ...] = ()
    problem = ""
    try:
        prepared = setup.build(scenario)
        model = prepared.plant.model
        integrator = next(k for k, v in mjcf.INTEGRATORS.items() if v == model.opt.integrator)
        rows.insert(
            2 + len(of_log),
            ("physics", f"{model.opt.timestep:g} s x {scenario.model.frame_skip}, {integrator}"),
        )
        channels = describe(prepared.channels, scenario.filter)
        noise = _noise(prepared)
    except EstbenchError as error:
        problem = " ".join(str(error).split())
    return Facts(
        source.title, scenario.description, tuple(rows), HEADINGS,
        tuple(channel.row() for channel in channels), noise,
        tuple(_differences(source, channels)), scenario.to_toml(), problem, log is not None,
    )  # fmt: skip


def _noise(prepared: setup.Setup) -> tuple[tuple[str, ...], ...]:
    """Coordinate, unit, initial σ, spectral density of the process noise on it."""
    space, noise, nv = prepared.space, prepared.disturbance, prepared.plant.model.nv
    density = np.diag(noise.density)
    text = [""] * space.n
    for i, q in enumerate(density):
        if noise.kind == "additive" and q:
            text[i] = f"{q:.3g} {units.density(space.units[i])}"
        elif noise.kind == "force" and q:
            force = "N" if space.units[i] == "m" else "N m"
            text[nv + i] = f"{q:.3g} {units.impulse_density(force)}"
    std = np.sqrt(np.diag(prepared.cov))
    rows = [
        (name, unit, f"{s:.3g}", q) for name, unit, s, q in zip(space.names, space.units, std, text)
    ]
    if noise.kind == "actuator":
        names = layout.control_names(prepared.plant.model)
        rows += [
            (name, "ctrl", "", f"{q:.3g} {units.impulse_density('ctrl')}")
            for name, q in zip(names, density)
            if q
        ]
    return tuple(rows)


def _differences(source: Stored, channels: Sequence[ChannelDescription]) -> list[str]:
    """How the true robot differs from the MJCF, and the filter's model from the true robot."""
    scenario = source.scenario
    lines = [f"truth: {key} = {value}" for key, value in scenario.truth.set.items()]
    for key, draw in scenario.truth.draw.items():
        spread = [f"{100 * draw.relative_std:g}%"] if draw.relative_std else []
        spread += [f"{draw.std:g}"] if draw.std else []
        lines.append(f"truth: {key} drawn once per run, σ = {' + '.join(spread) or '0'}")
    for name, field in type(scenario.filter).model_fields.items():
        value = getattr(scenario.filter, name)
        if name == "channels":
            lines += [f"filter: {c.name}: {', '.join(c.belief)}" for c in channels if c.belief]
        elif value != field.get_default(call_default_factory=True):
            lines += (
                [f"filter: {k} = {v}" for k, v in value.items()]
                if isinstance(value, dict)
                else [f"filter: {name} = {value}"]
            )
    return lines


@dataclass(frozen=True)
class Diverged:
    """One diverged run: time (None if the store does not have it) and cause."""

    entry: str
    run: int
    time: float | None
    step: int | None
    cause: str


def diverged(
    entries: Sequence[Entry], statistics: Sequence[TraceStatistics | None]
) -> list[tuple[str, int, list[Diverged]]]:
    """For each entry with diverged runs: its key, their count, and the first of them."""
    out = []
    for entry, traces in zip(entries, statistics):
        lost = np.flatnonzero(~entry.good)
        if not len(lost):
            continue
        section = entry.source.scenario.consistency
        times = entry.source.times
        rows = []
        for i in lost[:DIVERGED_ROWS]:
            run, fault = int(entry.source.runs[i]), int(entry.record["fault"][i])
            # NEES may pass the threshold long before the run fails: the first event is the cause.
            left = traces.left.get(run, math.nan) if traces is not None else math.nan
            step = int(entry.record["fault_step"][i]) if fault else None
            cause = Fault(fault).text if fault else ""
            if not fault or (math.isfinite(left) and step is not None and left < times[step]):
                cause = (
                    f"NEES/n above {section.divergence_threshold:g} for "
                    f"{section.divergence_duration:g} s" + (f", then {cause}" if cause else "")
                )
                step = int(np.searchsorted(times, left)) if math.isfinite(left) else None
            time = float(times[step]) if step is not None else None
            if entry.source.instants >= len(times):  # a long run: its times are a sample
                step = None
            rows.append(Diverged(entry.key, run, time, step, cause))
        out.append((entry.key, len(lost), rows))
    return out
