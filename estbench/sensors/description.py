"""The description of a channel that the command line, the report and error messages print."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from estbench.scenario.filter import BelievedChannelSection, FilterSection
from estbench.sensors.channel import Channel
from estbench.sensors.imperfections import Imperfections
from estbench.sensors.timing import Timing
from estbench.shapes import Array, Float

HEADINGS = ("channel", "reads", "noise σ", "unit", "rate", "latency", "imperfections")
"""Headings of `ChannelDescription.row`."""


@dataclass(frozen=True, eq=False)
class ChannelDescription:
    """What a channel reads, its noise, timing and imperfections, and what the filter believes.

    Attributes:
        name: the channel's name.
        kind: type of the MuJoCo sensors that it reads, or `function`.
        std: standard deviation of the white noise; of a scheduled R, that at t = 0.
        units: units of the reading, one per tangent coordinate.
        rate: mean rate of the readings, Hz.
        first: time of the first reading, s.
        jitter: largest deviation of the sampling time, s.
        latency: mean time from sampling to arrival, s.
        latency_std: standard deviation of the latency, s.
        imperfections: every error but white noise and latency, one phrase each.
        belief: what the filter believes where that differs from the truth, one phrase each.
    """

    name: str
    kind: str
    std: Float[Array, " m"]
    units: tuple[str, ...]
    rate: float
    first: float
    jitter: float
    latency: float
    latency_std: float
    imperfections: tuple[str, ...]
    belief: tuple[str, ...]

    @classmethod
    def of(
        cls, channel: Channel, belief: BelievedChannelSection | None = None
    ) -> "ChannelDescription":
        """The description of a channel.

        Args:
            channel: the true channel.
            belief: the scenario's `[filter.channels.NAME]`; None where it has none.
        """
        timing = channel.timing
        return cls(
            name=channel.name,
            kind=channel.kind,
            std=np.sqrt(np.diag(channel.cov)),
            units=channel.space.units,
            rate=timing.rate,
            first=timing.first,
            jitter=timing.jitter * timing.timestep,
            latency=timing.latency * timing.timestep,
            latency_std=timing.latency_std * timing.timestep,
            imperfections=tuple(_imperfections(channel)),
            belief=tuple(_belief(channel, belief or BelievedChannelSection())),
        )

    @property
    def noise_text(self) -> str:
        """σ of each unit, e.g. `0.1, 0.01` with the `unit_text` `m/s², rad/s`."""
        units = np.array(self.units)
        return ", ".join(numbers(self.std[units == unit]) for unit in dict.fromkeys(self.units))

    @property
    def unit_text(self) -> str:
        """The different units, in the order of `noise_text`."""
        return ", ".join(dict.fromkeys(self.units))

    @property
    def rate_text(self) -> str:
        """The rate, e.g. `200 Hz`."""
        return f"{self.rate:.5g} Hz"

    @property
    def latency_text(self) -> str:
        """The latency, e.g. `80 ms`, `80 ± 10 ms` or `2 s`; empty for none."""
        if not (self.latency or self.latency_std):
            return ""
        scale, unit = (1.0, "s") if self.latency >= 1.0 else (1e3, "ms")
        spread = f" ± {scale * self.latency_std:.2g}" if self.latency_std else ""
        return f"{scale * self.latency:.3g}{spread} {unit}"

    @property
    def imperfections_text(self) -> str:
        """The imperfections, or `white noise only`."""
        return ", ".join(self.imperfections) or "white noise only"

    @property
    def summary(self) -> str:
        """Kind, rate and latency, e.g. `framepos, 10 Hz, 80 ms late`."""
        late = [f"{self.latency_text} late"] if self.latency_text else []
        return ", ".join([self.kind, self.rate_text, *late])

    def row(self) -> tuple[str, ...]:
        """The cells of a table under `HEADINGS`."""
        return (
            self.name, self.kind, self.noise_text, self.unit_text, self.rate_text,
            self.latency_text, self.imperfections_text,
        )  # fmt: skip


def describe(channels: Sequence[Channel], section: FilterSection) -> tuple[ChannelDescription, ...]:
    """The descriptions of channels, with what the scenario's `[filter]` says of each."""
    return tuple(ChannelDescription.of(c, section.channels.get(c.name)) for c in channels)


def sight(names: Sequence[str], seen: bool) -> str:
    """What channels of accelerations and forces see of the disturbance; empty without any.

    Args:
        names: of these channels.
        seen: whether they see it.
    """
    if not names:
        return ""
    what = "control and disturbance" if seen else "control without the disturbance"
    return f"read under the {what} (process_noise.accelerometer_sees): {', '.join(names)}"


def numbers(values: Float[Array, " k"]) -> str:
    """The different values, in order; one number where all are equal."""
    return " ".join(dict.fromkeys(f"{v:.3g}" for v in values))


def _imperfections(channel: Channel) -> Iterator[str]:
    """Every error of a channel but white noise and latency, in the units of its reading."""
    if channel.schedule is not None:
        yield "noise by schedule"
    if not np.allclose(channel.cov, np.diag(np.diag(channel.cov))):
        yield "correlated noise"
    if channel.imperfections is not None:
        yield from _errors(channel.imperfections)
        yield from _transfer(channel.imperfections)
        yield from _faults(channel.imperfections)
    yield from _sampling(channel.timing)


def _errors(given: Imperfections) -> Iterator[str]:
    """Errors that are added to the reading or multiply it."""
    if given.bias.any():
        yield f"bias {numbers(given.bias)}"
    if given.walk.any():
        yield f"bias walk {numbers(given.walk)}/√s"
    if given.drift.any():
        yield f"drift {numbers(given.drift)} over {given.drift_time:g} s"
    if given.scale_factor.any():
        yield f"scale factor {numbers(100 * given.scale_factor)}%"
    if given.misalignment:
        yield f"misaligned {given.misalignment:.3g} rad"
    if given.student_dof:
        yield f"Student-t noise, {given.student_dof:g} degrees of freedom"
    if given.outlier_probability:
        yield f"{100 * given.outlier_probability:.3g}% outliers x {given.outlier_scale:g}"


def _transfer(given: Imperfections) -> Iterator[str]:
    """Saturation, quantization and deadband."""
    if np.isfinite(given.cutoff).any():
        yield f"saturates at ± {numbers(given.cutoff[np.isfinite(given.cutoff)])}"
    if given.quantization.any():
        yield f"steps of {numbers(given.quantization)}"
    if given.deadband.any():
        yield f"deadband {numbers(given.deadband)}"


def _faults(given: Imperfections) -> Iterator[str]:
    """Stuck-at faults and lost readings."""
    if given.stuck:
        yield f"{100 * given.stuck:.3g}% get stuck for {given.stuck_length:g}"
    if given.dropout:
        gaps = f" in gaps of {given.dropout_length:g}" if given.dropout_length > 1 else ""
        yield f"{100 * given.dropout:.3g}% lost{gaps}"


def _sampling(timing: Timing) -> Iterator[str]:
    """Jitter, and a first reading that is not due after one period."""
    if timing.jitter:
        yield f"jitter ± {1e3 * timing.jitter * timing.timestep:.3g} ms"
    if abs(timing.first - timing.interval) > 1e-6 * timing.timestep:
        yield f"first reading at {1e3 * timing.first:.3g} ms"


def _given(noise: float | list[float] | dict[str, float]) -> str:
    """Numbers as the scenario gives them, those of a table with their names."""
    if isinstance(noise, dict):
        return ", ".join(f"{value:g} ({name})" for name, value in noise.items())
    return numbers(np.atleast_1d(np.asarray(noise, float)))


def _belief(channel: Channel, belief: BelievedChannelSection) -> Iterator[str]:
    """What the filter believes of a channel, where that differs from the truth."""
    if belief.noise is not None:
        yield f"noise σ {_given(belief.noise)}"
    if belief.cov is not None:
        yield "another R"
    if belief.latency is not None:
        yield f"latency {1e3 * belief.latency:.3g} ms"
    if belief.timestamps == "due" and channel.timing.jitter:
        yield "no jitter"
    if belief.schedule is not None:
        yield "a schedule of its own"
    elif channel.schedule is not None and not belief.follow_schedule:
        yield "no schedule"
