"""The findings about the estimators of a results folder, and their text."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Group
from rich.padding import Padding
from rich.text import Text

from estbench.analysis.evidence import gather
from estbench.analysis.explain import Finding, explain
from estbench.analysis.load import Stored, load


@dataclass(frozen=True)
class Explanation:
    """What `estbench explain` says of one estimator.

    Attributes:
        label: of the estimator.
        verdict: in a word.
        findings: the faults that the evidence shows; none where everything is as it should be.
    """

    label: str
    verdict: str
    findings: tuple[Finding, ...]


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
    return Explanation(label, str(evidence.summary.verdict), tuple(explain(evidence)))


def render(found: Sequence[Explanation]) -> Group:
    """The findings for a rich console."""
    lines: list[Text | Padding] = []
    for e in found:
        lines.append(Text(f"{e.label}: {e.verdict}", style="bold"))
        if not e.findings:
            fine = Text("no fault shows in NEES, NIS, innovations or coordinates")
            lines.append(Padding(fine, (0, 0, 0, 2)))
        for finding in e.findings:
            lines.append(Padding(Text(finding.text), (0, 0, 0, 2)))
            help_ = Text(f"usually helps: {finding.remedy}", style="dim")
            lines.append(Padding(help_, (0, 0, 0, 4)))
    return Group(*lines)
