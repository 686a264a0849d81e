"""From the merged record of one estimator to its summary."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from estbench.consistency import statistics
from estbench.consistency.blocks import blocks
from estbench.consistency.declaration import Sample, Statistic
from estbench.consistency.fields import Record
from estbench.consistency.intervals import NONE
from estbench.consistency.phases import described
from estbench.consistency.reason import reason
from estbench.consistency.statistics import Failure, Summary
from estbench.consistency.verdict import Judgement, judge
from estbench.estimators.beliefs import Fault
from estbench.scenario.schema import ConsistencySection, ContactSection
from estbench.shapes import Array, Bool, Float, Mask

PHASES_BY_DEFAULT = ContactSection()


def summarize(
    label: str,
    record: Record,
    runs: Sequence[int],
    times: Float[Array, " time"],
    section: ConsistencySection,
    names: Sequence[str],
    channels: Sequence[str] = (),
    contact: ContactSection = PHASES_BY_DEFAULT,
    judged: tuple[Judgement, str] | None = None,
    truth: bool = True,
    instants: int | None = None,
) -> Summary:
    """The summary of one estimator.

    Args:
        label: the estimator's label.
        record: as `records.merge` gives it.
        runs: numbers of the runs in the record.
        times: of the instants and the start, s; of a long run those of a sample.
        section: level and tolerance of the verdict.
        names: of the coordinates.
        channels: their names; empty for a store of an earlier version.
        contact: which events of contact have a phase.
        judged: the judgement and its reason, if they are not those of the record.
        truth: whether it is known.
        instants: of a run; default one for each of the times but the start.
    """
    sample = Sample(record, section.level, instants or len(times) - 1)
    values: dict[str, Any] = {
        s.name: s.of(sample) if s.variables.keys() <= record.keys() else _unknown(s, record)
        for s in statistics.STATISTICS
    }
    judgement = judged[0] if judged else judge(record, section.level, section.tolerance)
    failed_at = float(times[max(judgement.failed_step, 0)])
    parts = blocks(times, section.burn_in)
    failures = (
        Failure(int(runs[i]), float(times[record["fault_step"][i]]), Fault(record["fault"][i]).text)
        for i in np.flatnonzero(record["fault"]).tolist()
    )
    return Summary(
        label=label,
        runs=len(runs),
        judgement=judgement,
        reason=judged[1]
        if judged
        else reason(
            judgement, names, channels, parts, section.tolerance, failed_at, described(contact)
        ),
        failures=tuple(failures),
        late=int(record["late"].sum()),
        gated=_gated(record),
        truth=truth,
        **_exact(record, sample.good),
        **values,
    )


def _gated(record: Record) -> float:
    """Share of the components that were refused; 0 if the store does not have it."""
    if "gated" not in record:
        return 0.0
    return float(record["gated"].sum() / max(record["received"].sum(), 1))


def _unknown(s: Statistic, record: Record) -> Any:
    """The value of a statistic whose variables a store of an earlier version lacks."""
    value = np.nan if s.form == "number" else NONE
    return value if s.per == "run" else (value,) * record["mse"].shape[1]


def _exact(record: Record, good: Bool[Mask, " run"]) -> dict[str, Any]:
    """What is known exactly, over the runs that did not diverge; nothing of older stores."""
    if "known" not in record or not good.any():
        return {}
    known = record["known"][good].mean(axis=0)
    return {"known": tuple(map(float, known)), "rank": float(record["rank"][good].mean())}


def exactly_known(summary: Summary, names: Sequence[str]) -> str:
    """A note about coordinates that the estimator knows exactly; empty if there are none.

    Args:
        summary: of one estimator.
        names: of the coordinates.
    """
    if not summary.known or summary.rank >= len(names):
        return ""
    said = []
    for name, share in zip(names, summary.known):
        if share > 0:
            often = "" if share > 0.9995 else f" in {share:.1%} of the steps"
            said.append(f"{name} is known exactly{often}")
    what = "; ".join(said) or "P is singular, so a combination of coordinates is known exactly"
    return f"{what}; NEES/n counts {summary.rank:.3g} of {len(names)} degrees of freedom"
