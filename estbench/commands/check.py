"""What there is (`estbench list`) and what a scenario amounts to (`estbench check`)."""

import importlib
from typing import Any

import mujoco
import numpy as np
from rich.console import Group
from rich.table import Table
from rich.text import Text

from estbench.errors import EstbenchError, ScenarioError, user_error_location
from estbench.estimators import registry
from estbench.experiment import setup
from estbench.models import observability
from estbench.robots import added_sensors, layout, mjcf
from estbench.scenario import load as scenario
from estbench.scenario.schema import FilterSection, Scenario, TruthSection
from estbench.sensors.description import ChannelDescription
from estbench.simulation import controllers

STAGES = ("none", "position", "velocity", "acceleration")


def catalogue() -> dict[str, dict[str, str]]:
    """Scenarios, estimators, controllers and sensor types, each with one line about it."""
    return {
        "scenarios": {
            name: scenario.load(path).description for name, path in scenario.bundled().items()
        },
        "estimators": {name: _first_line(target) for name, target in registry.known().items()},
        "controllers": controllers.KINDS,
        "sensor types": {
            name: layout.SENSOR_UNITS.get(name, "") for name in added_sensors.SENSOR_TYPES
        },
    }


def _first_line(target: str) -> str:
    module, _, name = target.partition(":")
    try:
        doc = getattr(importlib.import_module(module), name).__doc__ or ""
    except Exception as error:  # a broken plug-in must not break the list
        return f"cannot be imported: {user_error_location(error)}"
    return doc.strip().splitlines()[0] if doc.strip() else ""


def render_catalogue() -> Group:
    """The catalogue for a rich console."""
    parts: list[Any] = []
    for heading, entries in catalogue().items():
        if heading == "sensor types":
            parts.append(Text(f"\n{heading} (any MuJoCo sensor)", style="bold"))
            parts.append(Text(", ".join(entries)))
            continue
        table = Table(title=f"\n{heading}", title_justify="left", title_style="bold", box=None,
                      show_header=False)  # fmt: skip
        table.add_column(no_wrap=True)
        table.add_column()
        for name, line in entries.items():
            table.add_row(name, line)
        parts.append(table)
    return Group(*parts)


def mistakes(resolved: Scenario) -> list[str]:
    """What is wrong with a scenario that validates: a message for each of its independent parts.

    The bare robot is given one part after the other. One with which it cannot be built is a mistake
    and is left out of what follows, so that it hides no other.
    """
    fields, kept = Scenario.model_fields, ("name", "model", "simulation")
    defaults = {n: f.get_default(call_default_factory=True) for n, f in fields.items()}
    bare = {n: value for n, value in defaults.items() if n not in kept} | {"estimators": {}}
    good, found = resolved.model_copy(update=bare), []

    def add(**parts: Any) -> None:
        nonlocal good
        trial = good.model_copy(update=parts)
        try:
            setup.build(trial)
            good = trial
        except EstbenchError as error:
            found.append(str(error))

    belief, truth = resolved.filter, resolved.truth
    seen = FilterSection(channels=belief.channels)  # what is believed of them belongs to them
    add(sensors=resolved.sensors, channels=resolved.channels, filter=seen)
    if found:
        add()
        # The bare robot cannot be built either: it may have no sensor of its own.
        if len(found) > 1:
            return found[:1]
    add(filter=belief.model_copy(update={"channels": good.filter.channels}))
    add(truth=TruthSection(set=truth.set))
    add(truth=truth.model_copy(update={"set": good.truth.set}))
    for label, settings in resolved.estimators.items():
        add(estimators={**good.estimators, label: settings})
    add(start=resolved.start, estimators=good.estimators or {"ekf": {}})  # somebody must start
    for name in ("initial", "process_noise", "control", "consistency"):
        add(**{name: getattr(resolved, name)})
    return list(dict.fromkeys(found))


def render_check(resolved: Scenario) -> Group:
    """States, sensors and warnings of a scenario for a rich console.

    Raises:
        ScenarioError: the scenario cannot be built; every mistake that can be found is named.
    """
    try:
        prepared = setup.build(resolved)
    except EstbenchError as error:
        raise ScenarioError("; ".join(mistakes(resolved) or [str(error)])) from None
    model, space = prepared.plant.model, prepared.space
    head = (
        f"{resolved.name}: {space.n} coordinates, {model.nu} controls, timestep "
        f"{model.opt.timestep:g} s x {resolved.model.frame_skip}, "
        f"{mujoco.mjtIntegrator(model.opt.integrator).name.removeprefix('mjINT_')}"
    )
    states = Table(title="states", title_justify="left")
    for name in ("coordinate", "unit", "initial σ", "process noise"):
        states.add_column(name, justify="left" if name in ("coordinate", "unit") else "right")
    noise = _density(prepared)
    for i, (name, unit) in enumerate(zip(space.names, space.units)):
        states.add_row(name, unit, f"{np.sqrt(prepared.cov[i, i]):.3g}", noise[i])
    sensors = Table(title="sensors", title_justify="left")
    for name in ("channel", "type", "noise σ", "unit", "rate", "stage"):
        sensors.add_column(name, no_wrap=True)
    for channel in prepared.channels:
        described = ChannelDescription.of(channel)
        sensors.add_row(
            described.name,
            described.kind,
            described.noise_text,
            described.unit_text,
            described.rate_text,
            STAGES[max((model.sensor_needstage[i] for i in channel.measurand.sensors), default=0)],
        )
    control = resolved.control
    lines = [
        f"control: {control.kind}, seeing the {control.observe}",
        f"process noise: {prepared.disturbance.kind}",
        f"estimators: {', '.join(resolved.estimators)}",
    ]
    warnings = [*prepared.notices, *_warnings(prepared)]
    return Group(
        Text(head, style="bold"), states, sensors, *(Text(line) for line in lines),
        *(Text(f"warning: {w}", style="yellow") for w in warnings),
    )  # fmt: skip


def _density(prepared: setup.Setup) -> list[str]:
    """Spectral density beside the coordinate it enters, as text."""
    space, noise, nv = prepared.space, prepared.disturbance, prepared.plant.model.nv
    out = [""] * space.n
    diagonal = np.diag(noise.density)
    if noise.kind == "additive":
        return [f"{q:.3g} ({unit})²/s" if q else "" for q, unit in zip(diagonal, space.units)]
    if noise.kind == "force":
        for i, q in enumerate(diagonal):
            unit = "N" if space.units[i] == "m" else "N m"
            out[nv + i] = f"{q:.3g} ({unit})² s" if q else ""
    return out


def _warnings(prepared: setup.Setup) -> list[str]:
    section = prepared.scenario.model
    spec = mjcf.read(section.path)
    warnings = []
    for sensor in spec.sensors:
        if np.any(np.asarray(sensor.interval) > 0) and sensor.nsample == 0:
            warnings.append(
                f"sensor '{sensor.name}' has interval but nsample = 0: MuJoCo ignores the interval"
            )
        if sensor.delay > 0 and int(sensor.interp):
            warnings.append(
                f"sensor '{sensor.name}' interpolates its history: estbench delivers the samples"
            )
    hidden = observability.unseen(
        prepared.model(), prepared.mean, prepared.plant.u0, prepared.plant.period,
        np.sqrt(np.diag(prepared.cov)),
    )  # fmt: skip
    if hidden:
        warnings.append(f"no sensor can see {', '.join(hidden)} (linearized at the initial state)")
    return warnings
