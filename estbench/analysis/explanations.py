"""The findings about the estimators of a results folder, and their text."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Group
from rich.padding import Padding
from rich.text import Text

from estbench.analysis.evidence import gather
from estbench.analysis.explain import explain
from estbench.analysis.finding import Finding
from estbench.analysis.load import load
from estbench.analysis.stored import Stored


@dataclass(frozen=True)
class Explanation:
    """What `estbench explain` says of one estimator.

    Attributes:
        label: of the estimator.
        verdict: in a word.
        reason: what failed, where, when and by how much; empty for a consistent estimator.
        findings: the causes that the evidence shows; none where nothing is wrong.
        truth: whether the truth is known.
    """

    label: str
    verdict: str
    reason: str
    findings: tuple[Finding, ...]
    truth: bool = True


def explanations(folder: str | Path, labels: Sequence[str] = ()) -> list[Explanation]:
    """The findings about some estimators of a results folder; default all.

    Raises:
        StoreError: it is no results folder.
        AnalysisError: no such estimator, or the store lacks what the rules need.
    """
    stored = load(folder)
    return [of(stored, label) for label in labels or stored.records]


def of(stored: Stored, label: str) -> Explanation:
    """The findings about one estimator.

    Raises:
        AnalysisError: no such estimator, or the store lacks what the rules need.
    """
    evidence = gather(stored, label)
    summary = evidence.summary
    return Explanation(
        label, str(summary.verdict), summary.reason, tuple(explain(evidence)), summary.truth
    )


def render(found: Sequence[Explanation]) -> Group:
    """The findings for a rich console."""
    lines: list[Text | Padding] = []
    for e in found:
        lines.append(Text(f"{e.label}: {e.verdict}", style="bold"))
        what = e.reason or (
            "the errors are as large as the covariance says, the innovations white"
            if e.truth
            else "the innovations are as large as their covariance says, and white"
        )
        lines.append(Padding(Text(what), (0, 0, 0, 2)))
        for finding in e.findings:
            lines.append(Padding(Text(finding.text), (0, 0, 0, 2)))
            help_ = Text(f"usually helps: {finding.remedy}", style="dim")
            lines.append(Padding(help_, (0, 0, 0, 4)))
    return Group(*lines)
