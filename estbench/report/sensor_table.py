"""`estbench sensors`: a table of a scenario's channels, what is wrong with each in words."""

from collections.abc import Iterator

import numpy as np
from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from estbench.experiment.setup import Setup
from estbench.scenario.schema import BelievedChannelSection
from estbench.sensors.channel import Channel
from estbench.sensors.imperfections import Imperfections
from estbench.shapes import Array


def render(setup: Setup) -> Group:
    """Type, noise, rate, latency and imperfections of each channel, for a rich console."""
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, collapse_padding=True)
    for heading in ("channel", "reads", "noise σ", "unit", "rate", "latency", "imperfections"):
        right = heading in ("noise σ", "rate", "latency")
        table.add_column(
            heading, justify="right" if right else "left", no_wrap=heading != "imperfections"
        )
    for channel in setup.channels:
        table.add_row(
            channel.name,
            channel.kind,
            numbers(np.sqrt(np.diag(channel.cov))),
            " ".join(dict.fromkeys(channel.space.units)),
            f"{channel.timing.rate:.5g} Hz",
            latency(channel),
            ", ".join(words(channel)) or "white noise only",
        )
    lines = [Text(line) for line in _believed(setup)]
    lines += [Text(f"note: {notice}", style="dim") for notice in setup.notices]
    return Group(Text(setup.scenario.name, style="bold"), table, *lines)


def latency(channel: Channel) -> str:
    """`80 ms`, `80 ± 10 ms`, `2 s` or nothing."""
    timing = channel.timing
    mean, std = (t * timing.timestep for t in (timing.latency, timing.latency_std))
    if not (mean or std):
        return ""
    scale, unit = (1.0, "s") if mean >= 1.0 else (1e3, "ms")
    return f"{scale * mean:.3g}{f' ± {scale * std:.2g}' if std else ''} {unit}"


def words(channel: Channel) -> Iterator[str]:
    """What is wrong with a channel beside its white noise, in units of its reading."""
    timing = channel.timing
    if channel.schedule is not None:
        yield "noise by schedule"
    if not np.allclose(channel.cov, np.diag(np.diag(channel.cov))):
        yield "correlated noise"
    if channel.imperfections is not None:
        yield from _flaws(channel.imperfections)
    if timing.jitter:
        yield f"jitter ± {1e3 * timing.jitter * timing.timestep:.3g} ms"


def _flaws(imperfections: Imperfections) -> Iterator[str]:
    if imperfections.bias.any():
        yield f"bias {numbers(imperfections.bias)}"
    if imperfections.walk.any():
        yield f"bias walk {numbers(imperfections.walk)}/√s"
    if imperfections.drift.any():
        yield f"drift {numbers(imperfections.drift)} over {imperfections.drift_time:g} s"
    if imperfections.scale_factor.any():
        yield f"scale factor {numbers(100 * imperfections.scale_factor)}%"
    if imperfections.misalignment:
        yield f"misaligned {imperfections.misalignment:.3g} rad"
    if imperfections.student_dof:
        yield f"Student-t noise, {imperfections.student_dof:g} degrees of freedom"
    if imperfections.outlier_probability:
        share = 100 * imperfections.outlier_probability
        yield f"{share:.3g}% outliers x {imperfections.outlier_scale:g}"
    if np.isfinite(imperfections.cutoff).any():
        yield f"saturates at ± {numbers(imperfections.cutoff[np.isfinite(imperfections.cutoff)])}"
    if imperfections.quantization.any():
        yield f"steps of {numbers(imperfections.quantization)}"
    if imperfections.deadband.any():
        yield f"deadband {numbers(imperfections.deadband)}"
    if imperfections.stuck:
        yield f"{100 * imperfections.stuck:.3g}% get stuck for {imperfections.stuck_length:g}"
    if imperfections.dropout:
        length = imperfections.dropout_length
        gaps = f" in gaps of {length:g}" if length > 1 else ""
        yield f"{100 * imperfections.dropout:.3g}% lost{gaps}"


def _believed(setup: Setup) -> Iterator[str]:
    """Where the filter believes something else."""
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
    """One number where all are the same, else all of them."""
    return " ".join(dict.fromkeys(f"{v:.3g}" for v in values))
