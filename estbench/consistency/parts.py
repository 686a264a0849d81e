"""One run divided into parts of time, which take the place of runs: the sample of a recorded log.

A log is one run, so that nothing varies across runs. Averages over parts that are long against the
correlation of the errors are nearly independent (batch means; Law 2015, Simulation Modeling and
Analysis, sec. 9.5.3). Each part has the variables that a run has.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from estbench.consistency.blocks import Block, blocks
from estbench.consistency.fields import BatchTraces, Record
from estbench.consistency.innovations import (
    BLOCKS,
    InnovationSeries,
    by_part,
    judge,
    parts,
    reason,
)
from estbench.consistency.reason import reason as reason_of_errors
from estbench.consistency.records import COST, INNOVATIONS, PARTS, PER_RUN, SUFFIX
from estbench.consistency.statistics import Summary
from estbench.consistency.summary import summarize
from estbench.consistency.verdict import judge as judge_errors
from estbench.inference.lags import correlation
from estbench.inference.traces import Traces
from estbench.scenario.schema import ConsistencySection
from estbench.shapes import Array, Bool, Float, Mask

LONG = 5.0
"""Length of a part over the correlation time of the errors, at least."""
OF_INNOVATIONS = {
    "anis", "channel_nis", "log_likelihood", "received", "gated", "nis_by_block", "anis_by_phase",
    "diverged", "fault", "fault_step", "late",
}  # fmt: skip
"""Variables that need no truth; they count the instants without truth too."""


def of_log(
    traces: Traces,
    times: Float[Array, " time"],
    settled: Bool[Mask, " time"],
    diverged: bool,
    series: InnovationSeries,
    most: int = BLOCKS,
) -> Record:
    """The sample of one run, a row for each part.

    The parts divide the updates evenly. The log-likelihood of a part is multiplied by the count of
    parts, so that its mean is that of the log.

    Args:
        traces: of one run; errors are NaN where the truth is not known.
        times: of the instants and the start, s.
        settled: instants that count in averages.
        diverged: whether the run did.
        series: of the updates at the settled instants.
        most: parts, of `most_parts`.
    """
    counted = np.flatnonzero(settled & np.append(False, traces.dof[:, 0] > 0))
    known = np.isfinite(traces.error).any(axis=(1, 2))
    whole = BatchTraces(traces, times, settled, np.array([diverged]), ())
    divided = parts(np.arange(len(counted)), most)
    starts = [0, *(int(counted[part[0]]) for part in divided[1:]), len(times)]
    rows = []
    for start, end in pairwise(starts):
        here = settled.copy()
        here[:start], here[end:] = False, False
        block = Block(float(times[max(start - 1, 0)]), float(times[end - 1]))
        part = replace(whole, settled=here, blocks=(block,))
        judged = replace(part, settled=here & known) if (here & known).any() else part
        rows.append({
            name: field.values(part if name in OF_INNOVATIONS else judged)
            for name, field in PER_RUN.items()
        })  # fmt: skip
    sample = {name: np.concatenate([row[name] for row in rows]) for name in PER_RUN}
    sample |= by_part(series, divided)
    sample["lag_one"] = correlation(sample["lags"], sample["lag_terms"])[:, 1]
    sample["log_likelihood"] = sample["log_likelihood"] * len(rows)
    for name in ("fault", "late"):  # of the run as a whole: said once
        sample[name][1:] = 0
    return sample | {name: field.values(whole).repeat(len(rows)) for name, field in COST.items()}


def most_parts(traces: Traces, settled: Bool[Mask, " time"]) -> int:
    """Parts of a log that are `LONG` times as long as the errors are correlated; at most `BLOCKS`.

    Of the coordinate with the longest correlation time τ = 1 + 2 Σ ρₗ of e/σ less its mean, up to
    the first ρₗ that is not positive, in instants. White innovations alone need no such length.

    Args:
        traces: of one run; errors are NaN where the truth is not known.
        settled: instants that count in averages.
    """
    longest = 0.0
    with np.errstate(invalid="ignore", divide="ignore"):
        scaled = traces.error[settled, 0] / traces.sigma[settled, 0]
    for values in scaled.T:
        z = values[np.isfinite(values)]
        if len(z) < 2 or not np.ptp(z):
            continue
        z = z - z.mean()
        size = 1 << (2 * len(z) - 1).bit_length()  # padded with zeros against wrap-around
        products = np.fft.irfft(np.abs(np.fft.rfft(z, size)) ** 2, size)[: len(z)]
        rho = products / products[0]
        end = int(np.argmax(rho <= 0)) or len(rho)
        longest = max(longest, 1 + 2 * float(rho[1:end].sum()))
    return int(np.clip(settled.sum() / (LONG * longest), 1, BLOCKS)) if longest else BLOCKS


def summarize_log(
    label: str,
    sample: Record,
    innovations: Record,
    times: Float[Array, " time"],
    section: ConsistencySection,
    names: Sequence[str],
    channels: Sequence[str],
    components: Sequence[str],
    truth: bool,
) -> Summary:
    """The summary of one estimator on a log: parts take the place of runs.

    Where no truth is known the verdict is that of the innovations. Where it is known the errors are
    judged too, and what they refute comes first.

    Args:
        label: of the estimator.
        sample: of `of_log`.
        innovations: of `innovations.by_part`.
        times: of the instants and the start, s.
        section: level and tolerance of the verdict.
        names: of the coordinates.
        channels: their names.
        components: names of the components of the readings.
        truth: whether it is known.
    """
    failed = bool(sample["fault"].any())
    level, tolerance = section.level, section.tolerance
    if truth:  # two families of tests with one false-alarm rate
        level = 1 - (1 - level) / 2
    of_innovations = judge(innovations, failed, level, tolerance)
    judged = of_innovations, reason(of_innovations, channels, components)
    if truth:
        of_errors = judge_errors(sample, level, tolerance)
        if of_errors.refuted or not of_innovations.refuted:
            spans = blocks(times, section.burn_in)
            judged = of_errors, reason_of_errors(
                of_errors, names, channels, spans, tolerance, rows="parts of such a length"
            )  # fmt: skip
    runs = [0] * len(sample["fault"])
    return summarize(
        label, sample, runs, times, section, names, channels, judged=judged, truth=truth
    )


def stored(sample: Record, innovations: Record) -> Record:
    """The sample and the record of innovations as they are stored, `(1, part, ...)`.

    Both are filled up to `BLOCKS` parts.
    """
    named = {f"{name}{SUFFIX}": value for name, value in sample.items()}
    named |= {f"innovation_{name}{SUFFIX}": value for name, value in innovations.items()}
    out = {}
    for name, field in (PARTS | INNOVATIONS).items():
        value = named[name]
        more = [(0, BLOCKS - len(value))] + [(0, 0)] * (value.ndim - 1)
        fill = np.nan if field.dtype == "f8" else 0
        out[name] = np.pad(value, more, constant_values=fill)[None]
    return out


def read(arrays: Record, cpu_time: float) -> tuple[Record, Record]:
    """The sample and the record of innovations from the arrays of a store.

    Args:
        arrays: those of `PARTS` and of `INNOVATIONS`.
        cpu_time: of the run, s.
    """
    used = arrays[f"received{SUFFIX}"][0] > 0
    used[0] = True
    sample = {name.removesuffix(SUFFIX): arrays[name][0][used] for name in PARTS}
    sample["cpu_time"] = np.full(int(used.sum()), cpu_time)
    used = np.isfinite(arrays[f"innovation_anis{SUFFIX}"][0])
    used[0] = True
    names = {name: name.removeprefix("innovation_").removesuffix(SUFFIX) for name in INNOVATIONS}
    return sample, {short: arrays[name][0][used] for name, short in names.items()}
