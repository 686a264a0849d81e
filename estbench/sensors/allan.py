"""Allan deviation: σ(τ)² is half the mean square difference of successive averages over τ.

Source: IEEE Std 952-1997, annex C: the overlapping estimator, and the Allan deviation of white
noise, a random walk and a Gauss-Markov drift.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from estbench.errors import EstbenchError, MissingExtraError
from estbench.sensors import timing
from estbench.sensors.channel import Channel
from estbench.sensors.description import ChannelDescription
from estbench.sensors.sampling import Sampler
from estbench.shapes import Array, Float


def deviation(
    values: Float[Array, " reading *any"],
    step: float,
    taus: Sequence[float] | Float[Array, " k"] | None = None,
) -> tuple[Float[Array, " tau"], Float[Array, " tau *any"]]:
    """Overlapping Allan deviation of readings of a rate, e.g. of a gyro in rad/s.

    Args:
        values: readings, evenly spaced; the other axes are independent records.
        step: time between readings, s.
        taus: averaging times, s, rounded to multiples of the step; default 12 per decade, up to a
            quarter of the record.

    Returns:
        Averaging times τ in s, and the deviation in the readings' unit.

    Raises:
        EstbenchError: fewer than 4 readings, or a τ longer than half the record.
    """
    count = len(values)
    if count < 4:
        raise EstbenchError(f"the record has {count} readings; an Allan deviation needs at least 4")
    if taus is None:
        last = max(1, count // 4)
        steps = np.unique(np.round(np.geomspace(1, last, 1 + int(12 * np.log10(last + 1)))))
    else:
        steps = np.unique(np.round(np.asarray(taus) / step))
    steps = steps.astype(np.int64)
    if steps[0] < 1 or 2 * steps[-1] > count:
        raise EstbenchError(
            f"tau goes from {steps[0] * step:g} to {steps[-1] * step:g} s; use {step:g} to "
            f"{count // 2 * step:g} s, half the record"
        )
    angle = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])
    square = []
    for m in steps.tolist():
        second = angle[2 * m :] - 2 * angle[m:-m] + angle[: -2 * m]
        square.append((second**2).mean(axis=0) / (2.0 * m**2))
    times: Array = (steps * step).astype(np.float64)
    return times, np.sqrt(np.array(square, dtype=np.float64))


@dataclass(frozen=True)
class NoiseParameters:
    """Noise parameters of one axis, as a datasheet gives them.

    Attributes:
        density: white noise, unit/√Hz.
        walk: random walk of the bias, unit/√s.
        drift: standard deviation of a first-order Gauss-Markov drift, unit.
        drift_time: correlation time of the drift, s.
    """

    density: float = 0.0
    walk: float = 0.0
    drift: float = 0.0
    drift_time: float = 1.0

    @classmethod
    def of(cls, channel: Channel, axis: int = 0) -> "NoiseParameters":
        """The parameters of one axis of a channel."""
        density = float(np.sqrt(channel.cov[axis, axis] * channel.timing.interval))
        imperfections = channel.imperfections
        if imperfections is None:
            return cls(density)
        walk, drift = float(imperfections.walk[axis]), float(imperfections.drift[axis])
        return cls(density, walk, drift, imperfections.drift_time)

    def expected(self, taus: Float[Array, " tau"]) -> Float[Array, " tau"]:
        """The Allan deviation at averaging times, s."""
        tau = np.asarray(taus, dtype=np.float64)
        r = tau / self.drift_time
        markov = 2 / r * (1 - (3 - 4 * np.exp(-r) + np.exp(-2 * r)) / (2 * r))
        return np.sqrt(
            self.density**2 / tau + self.walk**2 * tau / 3 + self.drift**2 * np.maximum(markov, 0)
        )


def at_rest(
    channel: Channel, duration: float, seed: int = 0, runs: int = 1
) -> Float[Array, "reading run m"]:
    """Readings of a channel whose true reading is zero.

    Raises:
        EstbenchError: the channel reads an attitude, or loses or delays readings.
    """
    gaps = channel.imperfections is not None and channel.imperfections.dropout > 0
    if gaps or not channel.space.flat or not channel.timing.punctual:
        described = ChannelDescription.of(channel)
        raise EstbenchError(
            f"channel '{channel.name}' has a quaternion, gaps, jitter or latency "
            f"({described.summary}; {described.imperfections_text}); an Allan deviation needs "
            "evenly spaced numbers"
        )
    named = [(channel.name, channel.timing)]
    step = channel.timing.timestep
    last = timing.instants(named, step, channel.timing.period, duration)[-1].tick
    sampler = Sampler([channel], runs, last)
    sampler.start(np.arange(runs), seed, range(runs), 0)
    clean = np.zeros((runs, channel.space.n))
    return np.array([sampler.at(tick, clean)[0].y for tick in channel.timing.due(last).tolist()])


def plot(channel: Channel, duration: float = 600.0, seed: int = 0, runs: int = 8) -> Any:
    """A matplotlib figure: the Allan deviation of each run at rest, and that of the datasheet.

    Args:
        channel: e.g. one of `setup.build(scenario).channels`.
        duration: length of each record, s.
        seed: seed of the random numbers.
        runs: count of records.

    Raises:
        MissingExtraError: matplotlib is not installed.
        EstbenchError: as `at_rest`.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtraError("matplotlib", "plot") from None
    taus, found = deviation(at_rest(channel, duration, seed, runs), channel.timing.interval)
    space = channel.space
    figure = Figure(figsize=(3.4 * space.n + 0.6, 3.4), layout="constrained")
    for axis, ax in enumerate(figure.subplots(1, space.n, sharey=True, squeeze=False)[0]):
        ax.loglog(taus, found[:, 0, axis], color="#56B4E9", linewidth=0.8, label="simulated runs")
        ax.loglog(taus, found[:, 1:, axis], color="#56B4E9", linewidth=0.8)
        expected = NoiseParameters.of(channel, axis).expected(taus)
        ax.loglog(taus, expected, "--", color="#D55E00", linewidth=1.6, label="datasheet")
        ax.set_title(space.names[axis], fontsize="medium")
        ax.set_xlabel("averaging time τ (s)")
        ax.grid(which="both", color="#dddddd", linewidth=0.4)
    figure.axes[0].set_ylabel(f"Allan deviation ({space.units[0]})")
    figure.axes[0].legend(frameon=False, fontsize="small")
    return figure
