"""What `estbench check` prints: the states, sensors and warnings of a scenario, or its mistakes."""

from typing import Any

import mujoco
import numpy as np
from rich.console import Group
from rich.table import Table
from rich.text import Text

from estbench.errors import EstbenchError, ScenarioError
from estbench.experiment import setup, unseen
from estbench.robots import mjcf
from estbench.scenario import code
from estbench.scenario.filter import FilterSection
from estbench.scenario.reference import seen
from estbench.scenario.schema import Scenario, TruthSection
from estbench.sensors.description import ChannelDescription
from estbench.tables import units
from estbench.tables.names import visible

STAGES = ("none", "position", "velocity", "acceleration")


def mistakes(resolved: Scenario) -> list[str]:
    """The mistakes of a scenario that validates, one message each.

    The independent sections are added to a scenario of the robot alone, one after the other. A
    section with which it cannot be built is a mistake, and is left out so that it hides no other.
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
    sensed = FilterSection(channels=belief.channels)  # they refer to the channels
    add(sensors=resolved.sensors, channels=resolved.channels, filter=sensed)
    if found:
        add()
        # If the robot alone cannot be built either, its own mistake hides all others.
        if len(found) > 1:
            return found[:1]
    add(filter=belief.model_copy(update={"channels": good.filter.channels}))
    add(truth=TruthSection(set=truth.set))
    add(truth=truth.model_copy(update={"set": good.truth.set}))
    for label, settings in resolved.estimators.items():
        add(estimators={**good.estimators, label: settings})
    add(
        start=resolved.start, estimators=good.estimators or {"ekf": {}}
    )  # a start needs an estimator
    for name in ("initial", "process_noise", "control", "consistency"):
        add(**{name: getattr(resolved, name)})
    return list(dict.fromkeys(found))


def render(resolved: Scenario) -> Group:
    """The states, sensors and warnings of a scenario, for a rich console.

    Raises:
        ScenarioError: the scenario cannot be built; all mistakes are listed.
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
    for name in ("channel", "type", "noise σ", "unit", "rate", "latency", "stage"):
        sensors.add_column(name, no_wrap=True)
    for channel in prepared.channels:
        described = ChannelDescription.of(channel)
        sensors.add_row(
            described.name,
            described.kind,
            described.noise_text,
            described.unit_text,
            described.rate_text,
            described.latency_text,
            STAGES[max((model.sensor_needstage[i] for i in channel.measurand.sensors), default=0)],
        )
    lines = [
        f"control: {resolved.control.kind}, seeing {seen(resolved)}",
        f"process noise: {prepared.disturbance.kind}",
        *([prepared.sight] if prepared.sight else []),
        f"estimators: {', '.join(resolved.estimators)}",
        *(f"code: {line}" for line in code.listed(resolved.model_dump(exclude_none=True))),
    ]
    warnings = [*prepared.notices, *_warnings(prepared)]
    return Group(
        Text(visible(head), style="bold"), states, sensors,
        *(Text(visible(line)) for line in lines),
        *(Text(visible(f"warning: {w}"), style="yellow") for w in warnings),
    )  # fmt: skip


def _density(prepared: setup.Setup) -> list[str]:
    """Spectral density of the process noise as text, one per coordinate that it enters."""
    space, noise, nv = prepared.space, prepared.disturbance, prepared.plant.model.nv
    out = [""] * space.n
    diagonal = np.diag(noise.density)
    if noise.kind == "additive":
        return [
            f"{q:.3g} {units.density(unit)}" if q else "" for q, unit in zip(diagonal, space.units)
        ]
    if noise.kind == "force":
        for i, q in enumerate(diagonal):
            unit = "N" if space.units[i] == "m" else "N m"
            out[nv + i] = f"{q:.3g} {units.impulse_density(unit)}" if q else ""
    return out


def _warnings(prepared: setup.Setup) -> list[str]:
    """MJCF settings that have no effect, and states that no sensor observes."""
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
    hidden = unseen.notice(prepared)
    if hidden:
        warnings.append(hidden)
    return warnings
