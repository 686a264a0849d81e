"""Is the simulation like the robot? Innovations and readings of a log beside simulated runs.

The log and N runs that are simulated like it are exchangeable if the robot is like the simulation:
then a statistic of the log is outside of those of all runs with probability 2/(N + 1).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy import signal

from estbench.errors import EstimatorError, LogError
from estbench.experiment.prepared import Setup
from estbench.experiment.recording import estimated, followed
from estbench.inference.innovations import readings
from estbench.inference.lags import correlation
from estbench.inference.traces import Traces
from estbench.logs.like import simulated
from estbench.logs.prepare import prepare
from estbench.logs.readings import ChannelReadings
from estbench.logs.replay import fused_of
from estbench.logs.source import Log, LogSource
from estbench.scenario.load import Chosen, Scenario, resolve
from estbench.sensors.delivery import Delivery
from estbench.shapes import Array, Float, Int, Ints
from estbench.spaces.manifold import Manifold

RUNS = 39
"""Simulated runs: a statistic is outside of all of them by chance with probability 5%."""
BANDS = (0.0, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)
"""Ends of the bands of the spectrum, in shares of half the sampling rate."""
SEGMENT = 256
"""Updates of a segment of the spectrum, at most."""


@dataclass(frozen=True, eq=False)
class Trait:
    """One statistic of the log and of each simulated run.

    Attributes:
        component: of the reading; "all" for the filter as a whole.
        name: of the statistic.
        unit: of its values.
        log: of the log.
        runs: of each run `(run,)`.
    """

    component: str
    name: str
    unit: str
    log: float
    runs: Float[Array, " run"]

    @property
    def differs(self) -> bool:
        """Whether the log is outside of all runs."""
        return not (self.runs.min() <= self.log <= self.runs.max())


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Power spectral density of the scaled innovations of one component, 1/Hz; white: 2/rate.

    Attributes:
        component: of the reading.
        frequency: Hz `(f,)`.
        log: of the log `(f,)`.
        runs: of each run `(f, run)`.
        rate: of the readings, Hz, from the median interval.
    """

    component: str
    frequency: Float[Array, " f"]
    log: Float[Array, " f"]
    runs: Float[Array, "f run"]
    rate: float


@dataclass(frozen=True, eq=False)
class Likeness:
    """One estimator on the log and on the runs that are simulated like it.

    Attributes:
        label: of the estimator.
        traits: statistics.
        spectra: of the innovations, one for each component.
        failed: simulated runs that failed, and are left out.
    """

    label: str
    traits: tuple[Trait, ...]
    spectra: tuple[Spectrum, ...]
    failed: int

    @property
    def differing(self) -> tuple[Trait, ...]:
        """The statistics of the log that no run has."""
        return tuple(t for t in self.traits if t.differs)


@dataclass(frozen=True, eq=False)
class Comparison:
    """A log beside runs that are simulated like it.

    Attributes:
        prepared: the robot and the estimators, with the instants of the log.
        log: mapped to its channels and controls.
        runs: count of simulated runs.
        found: one for each estimator.
    """

    prepared: Setup
    log: Log
    runs: int
    found: tuple[Likeness, ...]


def like(
    scenario: str | Path | Scenario,
    logs: str | Path | Sequence[str | Path],
    estimators: Chosen | None = None,
    *,
    hold_out: Sequence[str] = (),
    runs: int = RUNS,
    overrides: Sequence[str] = (),
) -> Comparison:
    """Simulate a robot like a log, run each estimator on both, and compare its innovations.

    Args:
        scenario: with a section `[log]`; each estimator's model, Q and R are those of its robot.
        logs: the files of one log.
        estimators: labels, names or classes, in place of the scenario's.
        hold_out: channels that are not fused; their readings are compared.
        runs: how many are simulated.
        overrides: `section.key=value` strings.

    Raises:
        LogError: there are too few runs.
        EstbenchError: the log does not fit the scenario, or an estimator cannot run on it.
    """
    if runs < 2:
        raise LogError(f"--runs is {runs}; simulate at least 2 runs like the log, better {RUNS}")
    resolved = resolve(scenario, estimators, overrides=overrides)
    files = [logs] if isinstance(logs, str | Path) else list(logs)
    prepared, log = prepare(resolved, files, hold_out)
    fused = fused_of(prepared, hold_out)
    labels = prepared.scenario.estimators
    found = tuple(_likeness(prepared, log, fused, label, range(runs)) for label in labels)
    return Comparison(prepared, log, runs, found)


def _likeness(
    prepared: Setup, log: Log, fused: Sequence[str], label: str, runs: Sequence[int]
) -> Likeness:
    own = followed(prepared, label, [0], LogSource(log, fused), keep_innovations=True)
    truth = simulated(prepared, label, log, runs)
    given = [[d for d in all_ if d.channels[0] in fused] for all_ in truth.deliveries]
    source = replace(truth, deliveries=given)
    made = estimated(prepared, label, runs, source, keep_innovations=True)
    if own is None or made is None or own.fault[0]:
        raise EstimatorError(f"{label} fails on the log; see `estbench replay`")
    good = np.flatnonzero(made[0].fault == 0)
    if len(good) < 2:
        raise EstimatorError(f"{label} fails in {len(runs) - len(good)} of {len(runs)} runs")
    traits, spectra = _whole(own, made[0], good), []
    spaces = prepared.channel_spaces
    every = readings(spaces)
    for channel in fused:
        for name, unit in zip(readings({channel: spaces[channel]}), spaces[channel].units):
            own_part, spectrum = _innovations(
                log, own, made[0], good, every.index(name), name, unit
            )
            traits += own_part
            spectra.append(spectrum)
    for part in log.channels:
        traits += _readings(part, spaces[part.name], truth.deliveries, good)
    return Likeness(label, tuple(traits), tuple(spectra), len(runs) - len(good))


def _innovations(
    log: Log, own: Traces, made: Traces, good: Int[Ints, " good"], column: int, name: str, unit: str
) -> tuple[list[Trait], Spectrum]:
    """The innovations of one component."""
    size, scaled = ([a[..., column] for a in pair] for pair in zip(_scaled(own), _scaled(made)))
    here = np.isfinite(size[0][:, 0])
    size, scaled = ((a[here], b[here][:, good]) for a, b in (size, scaled))
    ends = np.array([i.end for i in log.instants])[here]
    rate = float(1 / np.median(np.diff(ends)))
    spectrum = Spectrum(name, *_density(scaled, rate), rate)
    return [
        _trait(name, "RMS innovation", unit, size, lambda a: np.sqrt(np.mean(a**2, axis=0))),
        _trait(name, "mean innovation/σ", "1", scaled, lambda a: a.mean(axis=0)),
        _trait(name, "(innovation/σ)²", "1", scaled, lambda a: np.mean(a**2, axis=0)),
        _trait(name, "beyond 3σ", "1", scaled, lambda a: np.mean(np.abs(a) > 3, axis=0)),
        _trait(name, "lag-one correlation", "1", scaled, _lag_one),
        *_bands(spectrum),
    ], spectrum


def _trait(
    component: str,
    name: str,
    unit: str,
    pair: tuple[Array, Array],
    function: Callable[[Array], Array],
) -> Trait:
    log, runs = (np.asarray(function(a)) for a in pair)
    return Trait(component, name, unit, float(log[0]), runs)


def _whole(own: Traces, made: Traces, good: Int[Ints, " good"]) -> list[Trait]:
    """NIS/m and log-likelihood of an update."""

    def nis(traces: Traces) -> Array:
        return np.nansum(traces.nis, axis=0) / traces.dof.sum(axis=0)

    def likelihood(traces: Traces) -> Array:
        return traces.log_likelihood.sum(axis=0) / (traces.dof > 0).sum(axis=0)

    return [
        Trait("all", "NIS/m", "1", float(nis(own)[0]), nis(made)[good]),
        Trait("all", "log-likelihood per update", "1", float(likelihood(own)[0]),
              likelihood(made)[good]),
    ]  # fmt: skip


def _scaled(traces: Traces) -> tuple[Array, Array]:
    """ν and ν/√S of each component `(time-1, run, m)`."""
    assert traces.innovation is not None
    assert traces.innovation_cov is not None
    std = np.sqrt(np.diagonal(traces.innovation_cov[1:], axis1=-2, axis2=-1))
    return traces.innovation[1:], traces.innovation[1:] / std


def _lag_one(z: Float[Array, "k run"]) -> Float[Array, " run"]:
    sums = np.stack([(z * z).sum(axis=0), (z[1:] * z[:-1]).sum(axis=0)], axis=-1)
    return correlation(sums, np.broadcast_to(np.array([len(z), len(z) - 1]), sums.shape))[:, 1]


def _density(
    pair: tuple[Array, Array], rate: float
) -> tuple[Float[Array, " f"], Float[Array, " f"], Float[Array, "f run"]]:
    """Frequencies, and Welch's estimate (1967) of the log and of the runs."""
    count = min(SEGMENT, len(pair[0]))
    plain: dict[str, Any] = {"detrend": False, "axis": 0}
    frequency, log = signal.welch(pair[0], rate, nperseg=count, **plain)
    _, runs = signal.welch(pair[1], rate, nperseg=count, **plain)
    return frequency, log[:, 0], runs


def _bands(found: Spectrum) -> list[Trait]:
    """The mean density in each band over that of white innovations of variance 1."""
    out, half = [], found.rate / 2
    for low, high in pairwise(BANDS):
        inside = (found.frequency >= low * half) & (found.frequency <= high * half)
        if not inside.any():  # of a short log
            continue
        log, runs = (half * a[inside].mean(axis=0) for a in (found.log, found.runs))
        name = f"spectrum, {low * half:.3g} to {high * half:.3g} Hz"
        out.append(Trait(found.component, name, "1", float(log), runs))
    return out


def _readings(
    part: ChannelReadings,
    space: Manifold,
    deliveries: Sequence[Sequence[Delivery]],
    good: Int[Ints, " good"],
) -> list[Trait]:
    """How far the readings of a channel move, and how often two in a row are equal."""
    if not space.flat:
        return []
    made = [d for some in deliveries for d in some if d.channels == (part.name,)]
    runs = np.stack([d.y for d in sorted(made, key=lambda d: d.taken)])[:, good]
    log = part.y[np.argsort(part.taken, kind="stable")]
    out = []
    for i, (name, unit) in enumerate(zip(readings({part.name: space}), space.units)):
        came = np.isfinite(log[:, i])
        pair = log[came, None, i], runs[came][..., i]
        out += [
            _trait(name, "std of the reading", unit, pair, lambda a: a.std(axis=0)),
            _trait(name, "unchanged readings", "1", pair,
                   lambda a: np.mean(a[1:] == a[:-1], axis=0)),
        ]  # fmt: skip
    return out
