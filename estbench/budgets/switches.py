"""An experiment without some sources of error, of which the filter believes what it did before."""

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from estbench.budgets.sources import Source
from estbench.experiment import believed as believing
from estbench.experiment.believed import Believed
from estbench.experiment.prepared import Setup
from estbench.robots import parameters
from estbench.robots.disturbance import Disturbance, axis_names
from estbench.scenario.filter import FilterSection
from estbench.sensors.channel import Channel
from estbench.sensors.imperfections import Imperfections
from estbench.shapes import Array

_NOTHING: Mapping[str, Any] = {
    "outliers": {"outlier_probability": 0.0}, "scale_factor": {"scale_factor": 0.0},
    "misalignment": {"misalignment": 0.0}, "quantization": {"quantization": 0.0},
    "cutoff": {"cutoff": np.inf}, "deadband": {"deadband": 0.0}, "stuck": {"stuck": 0.0},
    "dropout": {"dropout": 0.0}, "bias": {"bias": 0.0}, "walk": {"walk": 0.0},
    "drift": {"drift": 0.0},
}  # fmt: skip
"""Kind -> the imperfections that are then nothing."""


def without(setup: Setup, label: str, off: Collection[Source]) -> Setup:
    """The experiment in which some sources add no error.

    Only the truth, the sensors, or the wrong part of the filter's model change. P₀, Q, R and the
    random numbers of what is left stay as they are.

    Args:
        setup: the experiment.
        label: of the estimator.
        off: the sources.
    """
    kinds = {s.kind for s in off}
    channels = tuple(_channel(c, [s for s in off if s.target == c.name]) for c in setup.channels)
    made = replace(
        setup, channels=channels, disturbance=_disturbance(setup, off),
        scenario=_scenario(setup, label, off),
    )  # fmt: skip
    if "initial" in kinds:
        names = [s.target for s in off if s.kind == "initial"]
        kept = np.array([float("" not in names and n not in names) for n in setup.space.names])
        factor = setup.initial.factor * kept[:, None]
        made = replace(made, initial=replace(setup.initial, factor=factor))
    if kinds & {"parameter", "model"}:
        corrected = _believed(setup, label, off)
        made = replace(made, believed={**setup.believed, label: corrected})
    return made


def _channel(channel: Channel, off: Collection[Source]) -> Channel:
    kinds = {s.kind for s in off if s.group == channel.name}
    if "noise" in kinds:
        channel = replace(channel, cov=np.zeros_like(channel.cov), schedule=None)
    part: Imperfections | None = channel.imperfections
    if part is not None:
        for kind in kinds & _NOTHING.keys():
            ((name, value),) = _NOTHING[kind].items()
            old = getattr(part, name)
            new = np.full_like(old, value) if isinstance(old, np.ndarray) else value
            part = replace(part, **{name: new})
        channel = replace(channel, imperfections=part)
    if kinds & {"timing", "latency"}:
        timing = replace(channel.timing, latency=0.0, latency_std=0.0, history=0)
        channel = replace(channel, timing=timing)
    return channel


def _disturbance(setup: Setup, off: Collection[Source]) -> Disturbance:
    """The true process noise, with as many random numbers as before."""
    noise, targets = setup.disturbance, [s.target for s in off if s.kind == "process"]
    if not targets:
        return noise
    names = axis_names(setup.plant.model, setup.space, noise.kind)
    kept = np.array([float("" not in targets and name not in targets) for name in names])
    schedule = noise.schedule
    if schedule is not None and not kept.any():
        schedule = None  # it may return Q_s itself
    factor = kept[:, None] * noise.factor
    density = noise.density * np.outer(kept, kept)
    return replace(noise, factor=factor, density=density, schedule=schedule)


def _scenario(setup: Setup, label: str, off: Collection[Source]) -> Any:
    """The scenario without offsets of the start and without parameters that are drawn."""
    scenario = setup.scenario
    drawn = {s.target for s in off if s.kind == "draw"}
    if drawn:
        left = {key: draw for key, draw in scenario.truth.draw.items() if key not in drawn}
        truth = scenario.truth.model_copy(update={"draw": left})
        scenario = scenario.model_copy(update={"truth": truth})
    if any(s.kind == "offset" for s in off):
        settings = dict(scenario.estimators[label])
        start = setup.start(label).model_copy(update={"offset": 0.0})
        settings["start"] = start.model_dump()
        estimators = {**scenario.estimators, label: settings}
        scenario = scenario.model_copy(update={"estimators": estimators})
    return scenario


def _believed(setup: Setup, label: str, off: Collection[Source]) -> Believed:
    """What the filter believes of the robot, with some parameters of the truth."""
    side, truth = setup.believed[label], setup.plant.model
    if any(s.kind == "model" for s in off):
        own = {"path": None, "timestep": None, "integrator": None}
        section = FilterSection.model_validate(side.section.model_dump() | own)
        side = believing.build(
            setup.scenario, section, truth, setup.channels, setup.instants, setup.disturbance
        )
    changes: dict[str, Any] = {}
    for source in off:
        if source.kind == "parameter":
            field, index = parameters.parameter(truth, source.target, "budget")
            value: Array = np.asarray(getattr(truth, field)[index], np.float64)
            changes[source.target] = value.tolist()
    return replace(side, robot=parameters.changed(side.robot, changes, "budget"))
