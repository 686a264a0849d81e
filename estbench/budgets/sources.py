"""The sources of error of a scenario, each with the part of the experiment that it is.

A source adds an error of its own. A *condition* (dropout, an exactly handled latency) adds none: it
takes information away, so that it changes what all sources contribute.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from estbench.experiment.prepared import Setup
from estbench.robots import parameters
from estbench.robots.disturbance import axis_names
from estbench.sensors.channel import Channel

Kind = Literal[
    "initial", "offset", "process", "noise", "outliers", "bias", "walk", "drift", "scale_factor",
    "misalignment", "quantization", "cutoff", "deadband", "stuck", "timing", "parameter", "draw",
    "model", "dropout", "latency",
]  # fmt: skip
CONDITIONS = ("dropout", "latency")
"""Kinds that take information away and add no error."""
NONLINEAR = ("cutoff", "deadband", "stuck")
"""Kinds of which a linear analysis knows nothing."""


@dataclass(frozen=True)
class Source:
    """One source of error.

    Attributes:
        name: `initial.cart`, `process.root.vx`, `gyro.bias`, `parameter.body_mass.pole`, ...
        group: what it belongs to: `initial`, `process`, a channel, or `model`.
        kind: what it is.
        target: the coordinate, axis, channel or parameter; empty for all of the group.
    """

    name: str
    group: str
    kind: Kind
    target: str = ""


def sources(setup: Setup, label: str) -> tuple[Source, ...]:
    """The sources of error of one estimator, and the conditions after them.

    Args:
        setup: the experiment.
        label: of the estimator.
    """
    found = [*_initial(setup, label), *_process(setup)]
    for channel in setup.channels:
        found += [Source(f"{channel.name}.{k}", channel.name, k, channel.name)
                  for k in _of_channel(channel)]  # fmt: skip
        if is_late(channel):
            kind = "latency" if stamped(setup, label, channel) else "timing"
            found.append(Source(f"{channel.name}.{kind}", channel.name, kind, channel.name))
    found += _of_model(setup, label)
    return tuple(sorted(found, key=lambda source: source.kind in CONDITIONS))


def grouped(found: tuple[Source, ...]) -> tuple[Source, ...]:
    """The same with the initial error and the process noise as one source each."""
    out: dict[str, Source] = {}
    for source in found:
        whole = source.kind in ("initial", "process")
        name = source.group if whole else source.name
        out.setdefault(name, Source(name, source.group, source.kind, "") if whole else source)
    return tuple(out.values())


def diagonal(matrix: np.ndarray) -> bool:
    """Whether the components are independent, so that each may be a source."""
    return not np.count_nonzero(matrix - np.diag(np.diag(matrix)))


def by_axis(setup: Setup) -> bool:
    """Whether the components of the process noise are independent at all times."""
    noise = setup.disturbance
    whole = noise.schedule is not None and np.ndim(noise.schedule(0.0)) == 2
    return diagonal(noise.density) and not whole


def is_late(channel: Channel) -> bool:
    """Whether readings are taken at another time than they were due or arrive."""
    timing = channel.timing
    return bool(timing.latency or timing.latency_std or timing.jitter)


def stamped(setup: Setup, label: str, channel: Channel) -> bool:
    """Whether the filter fuses each reading of a channel at the time at which it was taken."""
    delays, timing = setup.delays(label), channel.timing
    wrong = channel.name in delays.believed or delays.handling == "naive"
    return not (wrong or (timing.jitter and channel.name in delays.nominal))


def different(setup: Setup, label: str) -> tuple[str, ...]:
    """Parameters that `filter.set` or `truth.set` makes different in the filter's model."""
    side, truth = setup.believed[label], setup.plant.model
    out = []
    for key in dict.fromkeys([*side.section.set, *setup.scenario.truth.set]):
        field, index = parameters.parameter(truth, key, "filter.set")
        true, own = (np.asarray(getattr(model, field)[index]) for model in (truth, side.robot))
        if not np.array_equal(true, own):
            out.append(key)
    return tuple(out)


def restructured(setup: Setup, label: str) -> bool:
    """Whether the filter's model has another file, timestep or integrator."""
    section = setup.believed[label].section
    return any(v is not None for v in (section.path, section.timestep, section.integrator))


def _initial(setup: Setup, label: str) -> list[Source]:
    out = []
    if setup.cov.any():
        out = [Source("initial", "initial", "initial")]
        if diagonal(setup.cov):
            out = [
                Source(f"initial.{name}", "initial", "initial", name)
                for name, variance in zip(setup.space.names, np.diag(setup.cov))
                if variance
            ]
    if setup.space.minus(setup.mean, setup.prior(label)[0]).any():
        out.append(Source("start.offset", "start", "offset"))
    return out


def _process(setup: Setup) -> list[Source]:
    noise = setup.disturbance
    if not noise.rank:
        return []
    if not by_axis(setup):
        return [Source("process", "process", "process")]
    names = axis_names(setup.plant.model, setup.space, noise.kind)
    return [
        Source(f"process.{name}", "process", "process", name)
        for name, row in zip(names, noise.factor)
        if row.any()
    ]


def _of_channel(channel: Channel) -> list[Kind]:
    part = channel.imperfections
    out: list[Kind] = ["noise"] if channel.cov.any() else []
    if part is None:
        return out
    used: tuple[tuple[Kind, object], ...] = (
        ("outliers", part.outlier_probability), ("bias", part.bias.any()),
        ("walk", part.walk.any()), ("drift", part.drift.any()),
        ("scale_factor", part.scale_factor.any()), ("misalignment", part.misalignment),
        ("quantization", part.quantization.any()), ("cutoff", np.isfinite(part.cutoff).any()),
        ("deadband", part.deadband.any()), ("stuck", part.stuck), ("dropout", part.dropout),
    )  # fmt: skip
    return [*out, *(kind for kind, on in used if on)]


def _of_model(setup: Setup, label: str) -> list[Source]:
    out = [Source(f"parameter.{key}", "model", "parameter", key) for key in different(setup, label)]
    out += [Source(f"draw.{key}", "model", "draw", key) for key in setup.scenario.truth.draw]
    if restructured(setup, label):
        out.append(Source("model", "model", "model"))
    return out
