"""The numbers of a scenario that matter to an estimator: of its own beliefs, and of the hardware.

A number that is zero has no relative change, and is left out.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from estbench.experiment.prepared import Setup
from estbench.robots.disturbance import axis_names
from estbench.scenario.believed import LOOP
from estbench.scenario.channels import ChannelSection
from estbench.sensitivities import physical
from estbench.sensitivities.parameter import Parameter
from estbench.sensors import schedules
from estbench.spaces.patterns import expand
from estbench.study import keys
from estbench.tables.units import density

IMPERFECTIONS = {
    "bias": "{unit}", "bias_walk": "{unit}/√s", "drift": "{unit}", "drift_time": "s",
    "bias_instability": "{unit}", "scale_factor": "", "misalignment": "rad",
    "quantization": "{unit}", "counts_per_revolution": "", "cutoff": "{unit}",
    "deadband": "{unit}", "outlier_probability": "", "outlier_scale": "", "student_dof": "",
    "dropout": "", "dropout_length": "", "stuck": "", "stuck_length": "", "jitter": "s",
    "latency_std": "s",
}  # fmt: skip
"""Key of a channel -> unit; `{unit}` is that of its reading."""
ONLY_WITH = {
    "outlier_scale": "outlier_probability", "dropout_length": "dropout", "stuck_length": "stuck",
    "drift_time": "drift",
}  # fmt: skip
"""Keys that say nothing where another one is zero."""


def parameters(setup: Setup, label: str, by_source: bool = False) -> tuple[Parameter, ...]:
    """All numbers of a scenario that have an effect on an estimator.

    Args:
        setup: the experiment.
        label: of the estimator.
        by_source: whether each coordinate of P₀ and each component of the process noise is a
            parameter; else these are multiplied as a whole.
    """
    found = [*_beliefs(setup, label, by_source), *_hardware(setup, by_source)]
    return tuple(p for p in found if np.any(p.value))


def _beliefs(setup: Setup, label: str, by_source: bool) -> Iterator[Parameter]:
    """What the filter believes, which is set in the estimator's own table."""
    side, table = setup.believed[label], ("estimators", label)
    section, space = side.section, setup.space

    def belief(own: keys.Names, value: Any, unit: str = "", **more: Any) -> Parameter:
        return Parameter(keys.show(own), (*table, *own), "filter", value, unit, **more)

    for channel, believed in zip(setup.channels, side.channels):
        own, where = section.channels.get(channel.name), ("filter", "channels", channel.name)
        R = believed.cov / section.measurement_noise_scale
        if schedules.initial_covariance(channel.schedule) is None and np.diag(R).any():
            if _full(R):
                yield belief((*where, "cov"), R.tolist(), power=2)
            else:
                yield belief((*where, "noise"), np.sqrt(np.diag(R)).tolist(),
                             _unit(channel.space.units))  # fmt: skip
        if own is not None and own.latency:
            step = setup.plant.model.opt.timestep
            yield belief((*where, "latency"), own.latency, "s", kind="latency", step=float(step))
    if side.disturbance.rank:
        if by_source and not _full(side.disturbance.density):
            model = setup.plant.model
            rows = np.diag(side.disturbance.density) / section.process_noise_scale
            names = axis_names(model, space, side.disturbance.kind)
            units = _density_units(side.disturbance.kind, names, space)
            for name, value, unit in zip(names, rows.tolist(), units):
                yield belief(("filter", "process_noise", "density", name), value, unit)
        else:
            yield belief(("filter", "process_noise_scale"), section.process_noise_scale)
    start = setup.start(label)
    if start.method == "prior" and setup.cov.any():
        inflate = expand(start.inflate, space.names, "start.inflate", 1.0)
        if by_source:
            for name, value, variance in zip(space.names, inflate.tolist(), np.diag(setup.cov)):
                if variance:
                    yield belief(("start", "inflate", name), value)
        else:
            uniform = (inflate == inflate[0]).all()
            yield belief(("start", "inflate"), float(inflate[0]) if uniform else inflate.tolist())
    for key, value, unit in physical.parameters(side.robot):
        yield belief(("filter", "set", key), value, unit)
    timestep = float(side.robot.opt.timestep)
    yield belief(("filter", "timestep"), timestep, "s", kind="timestep")
    settings = {k: v for k, v in setup.settings(label).items() if k not in (*LOOP, "type")}
    for own, value in _numbers(settings):
        kind = "count" if isinstance(value, int) else "smooth"
        key = keys.show((*table, *own))
        yield Parameter(key, (*table, *own), "filter", value, kind=kind)


def _hardware(setup: Setup, by_source: bool) -> Iterator[Parameter]:
    """What the robot, its sensors and its surroundings have, and the filter knows of them."""
    scenario, model, space = setup.scenario, setup.plant.model, setup.space
    timestep = float(model.opt.timestep)

    def has(names: keys.Names, value: Any, unit: str = "", **more: Any) -> Parameter:
        return Parameter(keys.show(names), names, "hardware", value, unit, **more)

    for channel in setup.channels:
        section = scenario.channels.get(channel.name, ChannelSection())
        where, unit = ("channels", channel.name), _unit(channel.space.units)
        if schedules.initial_covariance(channel.schedule) is None:
            if section.cov is not None:
                yield has((*where, "cov"), section.cov, power=2)
            elif section.noise_density is not None:
                own = f"{unit}/√Hz" if unit else ""
                yield has((*where, "noise_density"), section.noise_density, own)
            elif channel.cov.any():
                yield has((*where, "noise"), np.sqrt(np.diag(channel.cov)).tolist(), unit)
        for key, own in IMPERFECTIONS.items():
            value = getattr(section, key)
            needed = ONLY_WITH.get(key)
            idle = needed is not None and not np.any(getattr(section, needed))
            if value is not None and np.any(value) and not idle:
                yield has((*where, key), value, own.format(unit=unit) if unit else "")
        if channel.timing.fractional is None:
            yield has((*where, "rate"), channel.timing.rate, "Hz", kind="rate", step=1 / timestep)
        if channel.timing.latency:
            yield has((*where, "latency"), float(channel.timing.latency) * timestep, "s",
                      kind="latency", step=timestep)  # fmt: skip
    noise, given = setup.disturbance, scenario.process_noise
    if noise.rank and given.matrix is not None:
        yield has(("process_noise", "matrix"), given.matrix)
    elif noise.rank:
        names, rows = axis_names(model, space, noise.kind), np.diag(noise.density).tolist()
        units = _density_units(noise.kind, names, space)
        if by_source:
            for name, value, unit in zip(names, rows, units):
                yield has(("process_noise", "density", name), value, unit)
        else:
            moved = [unit for unit, value in zip(units, rows) if value]
            yield has(("process_noise", "density"), rows, _unit(moved))
    if scenario.initial.cov is not None:
        yield has(("initial", "cov"), scenario.initial.cov, power=2)
    elif "std" not in scenario.initial.model_fields_set:
        pass  # a default that depends on the robot, and says how states at the start are projected
    elif by_source:
        std = expand(scenario.initial.std, space.names, "initial.std")
        for name, value, unit in zip(space.names, std.tolist(), space.units):
            yield has(("initial", "std", name), value, unit)
    else:
        std = expand(scenario.initial.std, space.names, "initial.std")
        known = [unit for unit, value in zip(space.units, std) if value]
        yield has(("initial", "std"), std.tolist(), _unit(known))
    for key, value, unit in physical.parameters(model):
        part = "truth" if key in scenario.truth.set else "model"
        yield has((part, "set", key), value, unit)
    for key, draw in scenario.truth.draw.items():
        for name in ("relative_std", "std"):
            yield has(("truth", "draw", key, name), getattr(draw, name))
    yield has(("model", "timestep"), timestep, "s", kind="timestep", frame_skip=True,
              step=float(scenario.model.frame_skip))  # fmt: skip


def _unit(units: Sequence[str]) -> str:
    """The unit that all have; empty where they differ."""
    return units[0] if units and len(set(units)) == 1 else ""


def _full(matrix: Any) -> bool:
    return bool(np.count_nonzero(matrix - np.diag(np.diag(matrix))))


def _density_units(kind: str, names: Sequence[str], space: Any) -> list[str]:
    if kind != "additive":
        return [""] * len(names)
    return [density(space.units[space.index(name)]) for name in names]


def _numbers(table: Mapping[str, Any], above: keys.Names = ()) -> Iterator[tuple[keys.Names, Any]]:
    """The positive numbers of nested tables."""
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _numbers(value, (*above, key))
        elif isinstance(value, int | float) and not isinstance(value, bool) and value > 0:
            yield (*above, key), value
