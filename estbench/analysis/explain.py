"""Why the verdict on an estimator fails: rules that each look for one cause in the evidence.

What failed, where, when and by how much is what the verdict refutes (`consistency/verdict.py`). A
rule is a function of the evidence. It answers with the cause and what usually helps, or with None.
The rules for causes that show in the settings or at one time are asked first. Only if they find
nothing are those asked that infer a cause from the innovations: a wrong start, for instance, leaves
the innovations of a Q that is too small.
"""

from collections.abc import Sequence

from estbench.analysis.direct_causes import DIRECT
from estbench.analysis.evidence import Evidence
from estbench.analysis.finding import Finding, Rule, sign
from estbench.analysis.inferred_causes import INFERRED
from estbench.consistency.verdict import FEW_LOST, Verdict
from estbench.estimators.beliefs import Fault
from estbench.tables.quantity import quantity


def explain(evidence: Evidence) -> list[Finding]:
    """The causes that the evidence shows, the most specific first.

    Where the verdict refutes something there is one at least, `unexplained` if no rule finds a
    cause. Where it refutes nothing only what is counted is named, and too few runs.
    """
    found = [finding for rule in COUNTED if (finding := rule(evidence)) is not None]
    if not evidence.refuted():
        return found
    for rules in (DIRECT, INFERRED, (unexplained,)):
        said = [finding for rule in rules if (finding := rule(evidence)) is not None]
        if said:
            return found + said
    return found


def failed(e: Evidence) -> Finding | None:
    """The truth of some runs could not be simulated."""
    count = e.summary.judgement.failed
    if not count:
        return None
    return Finding(
        "simulation",
        f"the simulation of the truth failed in {count} of {e.summary.runs} runs, which say "
        "nothing about the estimator",
        "a smaller `model.timestep`, process noise or `initial.std`",
    )


def lost(e: Evidence) -> Finding | None:
    """More runs diverged than a consistent filter may lose."""
    judgement = e.summary.judgement
    runs = e.summary.runs - judgement.failed
    if judgement.lost <= FEW_LOST * runs:
        return None
    reasons = {f.reason for f in e.summary.failures} - {Fault.TRUTH.text}
    why = f": {'; '.join(sorted(reasons))}" if reasons else ""
    return Finding(
        "lost", f"{judgement.lost} of {runs} runs diverged{why}",
        "a better start (`start.method = \"batch\"`, `start.inflate`), or a filter for stronger "
        "nonlinearity (`ukf`, `iekf`)",
    )  # fmt: skip


def too_late(e: Evidence) -> Finding | None:
    """Readings came after the window and were not fused."""
    if not e.summary.late:
        return None
    return Finding(
        "window", f"{e.summary.late} readings came later than filter.window and were not fused",
        "a longer `filter.window`",
    )  # fmt: skip


def undecided(e: Evidence) -> Finding | None:
    """The runs can neither refute nor show that the estimator is consistent."""
    judgement = e.summary.judgement
    if judgement.verdict is not Verdict.UNDECIDED:
        return None
    if e.components:
        return Finding(
            "undecided",
            "nothing is refuted, and the log is too short to show that the estimator is consistent",
            "a longer log, or a larger `consistency.tolerance`",
        )
    runs = f" (`--runs {judgement.needed}`)" if judgement.needed else ""
    return Finding(
        "undecided",
        "nothing is refuted, and the runs are too few to show that the estimator is consistent",
        f"more runs{runs}, or a larger `consistency.tolerance`",
    )


def unexplained(e: Evidence) -> Finding | None:
    """The verdict refutes something, and no rule says why."""
    errors = f"NEES/n is {quantity(e.nees)}, " if e.summary.truth else ""
    lag = f", the lag-one correlation {quantity(e.lag_one)}" if sign(e.lag_one) else ""
    return Finding(
        "unexplained",
        f"no cause is certain: {errors}NIS/m is {quantity(e.nis)}{lag}",
        "`estbench report` shows when and in which coordinates",
    )


COUNTED: Sequence[Rule] = (failed, lost, too_late, undecided)
"""Runs and readings: the other rules are asked too."""
