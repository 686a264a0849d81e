"""`estbench sensors`: a table of the channels of a scenario, their imperfections in words."""

from collections.abc import Iterator

import numpy as np
from rich.console import Group
from rich.text import Text

from estbench.experiment.setup import Setup
from estbench.scenario.schema import BelievedChannelSection
from estbench.sensors.channel import Channel
from estbench.sensors.imperfections import Imperfections
from estbench.shapes import Array
from estbench.tables.columns import Column, Table


def render(setup: Setup) -> Group:
    """Type, noise, rate, latency and imperfections of each channel, for a rich console."""
    rows = [
        (
            channel.name,
            channel.kind,
            numbers(np.sqrt(np.diag(channel.cov))),
            " ".join(dict.fromkeys(channel.space.units)),
            f"{rate(channel):.4g} Hz",
            latency(channel),
            ", ".join(words(channel)) or "white noise only",
        )
        for channel in setup.channels
    ]
    headings = ("channel", "reads", "noise σ", "unit", "rate", "latency", "imperfections")
    columns = tuple(
        Column(
            heading,
            tuple(row[i] for row in rows),
            "right" if heading in ("noise σ", "rate", "latency") else "left",
            wraps=heading == "imperfections",
        )
        for i, heading in enumerate(headings)
    )
    table = Table(columns[:1], (columns[1:],))
    lines = [Text(line) for line in _believed(setup)]
    lines += [Text(f"note: {notice}", style="dim") for notice in setup.notices]
    return Group(Text(setup.scenario.name, style="bold"), table, *lines)


def rate(channel: Channel) -> float:
    """Readings per second, Hz."""
    timing = channel.timing
    return 1 / ((timing.uneven[1] if timing.uneven else timing.period) * timing.timestep)


def latency(channel: Channel) -> str:
    """`80 ms`, `80 ± 10 ms`, `2 s` or an empty text."""
    timing = channel.timing
    mean, std = (t * timing.timestep for t in (timing.latency, timing.latency_std))
    if not (mean or std):
        return ""
    scale, unit = (1.0, "s") if mean >= 1.0 else (1e3, "ms")
    return f"{scale * mean:.3g}{f' ± {scale * std:.2g}' if std else ''} {unit}"


def words(channel: Channel) -> Iterator[str]:
    """The imperfections of a channel beside white noise, in units of its reading."""
    timing = channel.timing
    if channel.schedule is not None:
        yield "noise by schedule"
    if not np.allclose(channel.cov, np.diag(np.diag(channel.cov))):
        yield "correlated noise"
    if channel.part is not None:
        yield from _flaws(channel.part)
    if timing.jitter:
        yield f"jitter ± {1e3 * timing.jitter * timing.timestep:.3g} ms"


def _flaws(part: Imperfections) -> Iterator[str]:
    if part.bias.any():
        yield f"bias {numbers(part.bias)}"
    if part.walk.any():
        yield f"bias walk {numbers(part.walk)}/√s"
    if part.drift.any():
        yield f"drift {numbers(part.drift)} over {part.drift_time:g} s"
    if part.scale_factor.any():
        yield f"scale factor {numbers(100 * part.scale_factor)}%"
    if part.misalignment:
        yield f"misaligned {part.misalignment:.3g} rad"
    if part.student_dof:
        yield f"Student-t noise, {part.student_dof:g} degrees of freedom"
    if part.outlier_probability:
        yield f"{100 * part.outlier_probability:.3g}% outliers x {part.outlier_scale:g}"
    if np.isfinite(part.cutoff).any():
        yield f"saturates at ± {numbers(part.cutoff[np.isfinite(part.cutoff)])}"
    if part.quantization.any():
        yield f"steps of {numbers(part.quantization)}"
    if part.deadband.any():
        yield f"deadband {numbers(part.deadband)}"
    if part.stuck:
        yield f"{100 * part.stuck:.3g}% get stuck for {part.stuck_length:g}"
    if part.dropout:
        gaps = f" in gaps of {part.dropout_length:g}" if part.dropout_length > 1 else ""
        yield f"{100 * part.dropout:.3g}% lost{gaps}"


def _believed(setup: Setup) -> Iterator[str]:
    """The channels of which the filter believes something else."""
    section = setup.scenario.filter
    for channel in setup.channels:
        belief = section.channels.get(channel.name, BelievedChannelSection())
        said = []
        if belief.noise is not None:
            said.append(f"noise σ {numbers(np.atleast_1d(np.asarray(belief.noise, float)))}")
        if belief.cov is not None:
            said.append("another R")
        if belief.latency is not None:
            said.append(f"latency {1e3 * belief.latency:.3g} ms")
        if belief.timestamps == "due" and channel.timing.jitter:
            said.append("no jitter")
        if belief.schedule is not None:
            said.append("a schedule of its own")
        elif channel.schedule is not None and not belief.follow_schedule:
            said.append("no schedule")
        if said:
            yield f"the filter believes of {channel.name}: {', '.join(said)}"
    if section.measurement_noise_scale != 1.0:
        yield f"the filter believes R x {section.measurement_noise_scale:g} of every channel"


def numbers(values: Array) -> str:
    """One number if all are equal, else all of them."""
    return " ".join(dict.fromkeys(f"{v:.3g}" for v in values))
