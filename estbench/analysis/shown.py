"""The tables of a comparison for text, Markdown and LaTeX."""

import numpy as np

from estbench.analysis.compare import Comparison, Contest
from estbench.analysis.comparison import fewest_runs
from estbench.analysis.findings import TRIM
from estbench.consistency import statistics
from estbench.consistency.coverage import EXPECTED, SIGMAS
from estbench.consistency.statistics import RMSE, SIGMA
from estbench.tables.cells import cell, lost_note, marked, share, value_of
from estbench.tables.columns import Table, tabulate
from estbench.tables.phases import table as by_phase
from estbench.tables.quantity import bounds, number, percent, probability, quantity


def build(comparison: Comparison) -> list[Table]:
    """The tables of all contests."""
    out = []
    for contest in comparison.contests:
        out.append(Table((), (), _title(contest)))
        out += [_verdicts(contest, comparison), _ranking(contest, comparison)]
        out += [_pairs(contest, comparison)]
        out += [_accuracy(contest)] if contest.truth else []
        out += _by_coordinate(contest)
        phases = by_phase((f.key, f.phases) for f in contest.findings)
        out += [phases] if phases is not None else []
        last = (*([_coverage(contest)] if contest.truth else ()), _innovations(contest))
        out += [t for t in last if t.rows]
        if contest.stores[0].log is None:
            out.append(_needed(contest, comparison.precision))
    return out


def _title(contest: Contest) -> str:
    unfinished = [
        f"{s.folder} has {len(s.runs)} of {s.total} runs"
        for s in contest.stores
        if len(s.runs) < s.total
    ]
    return contest.title + (f" [unfinished: {'; '.join(unfinished)}]" if unfinished else "")


def _verdicts(contest: Contest, comparison: Comparison) -> Table:
    found = statistics.shown("compare", summaries=[f.summary for f in contest.findings])
    return tabulate(
        "Consistency",
        ("<estimator", "<verdict", *(s.heading_in("compare") for s in found)),
        [
            (
                f.key, str(f.summary.verdict),
                *(cell(s, value_of(f.summary, s), s.places["compare"]) for s in found),
            )
            for f in contest.findings
        ],
        f"± and brackets are {comparison.level:.0%} intervals across {_rows(contest)}; of the "
        "diverged share Wilson's." + "".join(
            f"\n{f.key}: {f.summary.reason}." for f in contest.findings if f.summary.reason
        ),
    )  # fmt: skip


def _rows(contest: Contest) -> str:
    """What the intervals are across."""
    return "runs" if contest.stores[0].log is None else "the parts of the log"


def _by_coordinate(contest: Contest) -> list[Table]:
    """A table for each statistic per coordinate that `compare` shows: a column per estimator."""
    first = contest.findings[0]
    return [
        tabulate(
            s.heading_in("compare"),
            ("<coordinate", "<unit", *(f.key for f in contest.findings)),
            [
                (name, unit, *(cell(s, value_of(f.summary, s)[i], s.places["compare"])
                               for f in contest.findings))
                for i, (name, unit) in enumerate(zip(first.stored.names, first.stored.units))
            ],
            s.note,
        )
        for s in statistics.shown(
            "compare", "coordinate", [f.summary for f in contest.findings]
        )
    ]  # fmt: skip


def few_runs(runs: int, estimators: int, level: float) -> str:
    """A warning if the runs are too few for any significant difference, else an empty text."""
    needed = fewest_runs(estimators, level)
    if runs >= needed or estimators < 2:
        return ""
    return (
        f" With {runs} runs no two of {estimators} estimators can be told apart: take {needed} or "
        "more."
    )


def _ranking(contest: Contest, comparison: Comparison) -> Table:
    verdicts = {f.key: str(f.summary.verdict) for f in contest.findings}
    return tabulate(
        "Ranking by RMSE" if contest.truth else "Ranking by log-likelihood",
        ("rank", "<estimator", "<verdict", f"{_score(contest)} / first", "in ranks", "lost"),
        tuple(
            (
                f"{r.place}{'=' if r.tied else ''}", r.key, verdicts[r.key],
                "1" if i == 0 else bounds(r.ratio),
                f"{r.place}–{r.last}" if r.last > r.place else f"{r.place}", share(r.lost),
            )
            for i, r in enumerate(contest.ranks)
        ),
        (
            "The ratio is the geometric mean over the coordinates. "
            if contest.truth
            else "Ratio of exp(-log-likelihood per component of a reading): less is better. "
        )
        + "= is a tie: not told apart at "
        f"{comparison.level:.0%} (Wilcoxon, Holm over all pairs), or by less than "
        f"{comparison.margin:.2g} of the error."
        + few_runs(len(contest.runs), len(contest.findings), comparison.level),
    )  # fmt: skip


def _score(contest: Contest) -> str:
    return "RMSE" if contest.truth else "1/density"


def _pairs(contest: Contest, comparison: Comparison) -> Table:
    rows = [
        (
            pair.a, pair.b, bounds(pair.ratio, 4), f"{p.less}/{p.more}/{p.ties}",
            probability(pair.sign), probability(pair.wilcoxon),
            *([quantity(nees)] if contest.truth else []), quantity(likely),
        )
        for pair, nees, likely in zip(contest.pairs, contest.nees, contest.log_likelihood)
        for p in [pair.paired]
    ]  # fmt: skip
    return tabulate(
        "Pairs on common random numbers" if contest.stores[0].log is None else "Pairs on one log",
        (
            "<a",
            "<b",
            f"{_score(contest)} a/b",
            "a less/more/tie",
            "sign p",
            "Wilcoxon p",
            *(["NEES/n a-b"] if contest.truth else []),
            "log-lik. a-b",
        ),
        rows,
        "p-values are Holm's, over these pairs; runs that one lost count as worse. The "
        "log-likelihood compares models of the same readings: larger is better.",
    )


def _accuracy(contest: Contest) -> Table:
    return tabulate(
        RMSE.heading,
        ("<estimator", "unit", "mean", "trimmed mean", "median", SIGMA.heading),
        tuple(
            (
                f.key if i == 0 else "", a.unit, marked(quantity(a.mean), f.summary),
                quantity(a.trimmed),
                quantity(a.median), number(a.sigma),
            )
            for f in contest.findings
            for i, a in enumerate(f.accuracy)
        ),
        "Of the norm of all coordinates of a unit. The mean is over runs that did not diverge; "
        f"the mean without {TRIM:.0%} at each end and the median are over all runs."
        + "".join(f" {note}." for note in lost_note(f.summary for f in contest.findings)),
    )  # fmt: skip


def _coverage(contest: Contest) -> Table:
    return tabulate(
        "Coverage: errors within 1σ, 2σ, 3σ, %",
        ("<estimator", "unit", *(f"{k}σ ({100 * e:.2f})" for k, e in zip(SIGMAS, EXPECTED))),
        tuple(
            (
                f.key if k == 0 else "",
                a.unit,
                *(quantity(i.scaled(100)) for i in a.coverage.shares),
            )
            for f in contest.findings
            for k, a in enumerate(f.accuracy)
            if a.coverage is not None
        ),
        "Expected of normal errors in brackets.",
    )


def _innovations(contest: Contest) -> Table:
    rows, found = [], statistics.shown("innovations")
    for f in contest.findings:
        if f.whiteness is None and f.nci is None:
            continue
        white = ("–", "–") if f.whiteness is None else (
            percent(f.whiteness.rejected), probability(f.whiteness.p),
        )  # fmt: skip
        nci = ("–", "–")
        if f.nci is not None and f.inclination is not None and np.isfinite(f.nci):
            best = number(f.nci_expected or np.nan, 3)
            nci = (f"{f.nci:.3f} ({best})", f"{f.inclination:+.3f}")
        ours = (cell(s, value_of(f.summary, s), s.places["innovations"]) for s in found)
        rows.append((f.key, *ours, *white, *nci))
    level = contest.stores[0].scenario.consistency.level
    return tabulate(
        "Innovations and credibility",
        (
            "<estimator", *(s.heading_in("innovations") for s in found),
            "runs not white", "pooled p", "NCI, dB", "inclination, dB",
        ),
        rows,
        f"Ljung-Box: {1 - level:.0%} of the runs are expected. NCI: 0 is credible, in brackets "
        "what this many runs give at best; inclination: above 0 optimistic." + _no_nci(contest),
    )  # fmt: skip


def _no_nci(contest: Contest) -> str:
    """Why estimators have no NCI; empty where all have one."""
    by_reason: dict[str, list[str]] = {}
    for f in contest.findings:
        if f.nci is not None and np.isfinite(f.nci):
            continue
        good, n = int((~f.record["diverged"].astype(bool)).sum()), f.stored.n
        if f.stored.log is not None:
            reason = "it compares runs, and a log is one"
        elif not f.stored.has_traces:
            reason = "the errors of each run are not stored (`estbench run --keep diagonal`)"
        elif good <= n:
            reason = f"it needs more than {n} runs that did not diverge, and there are {good}"
        else:
            reason = "the errors of the runs have no invertible covariance"
        by_reason.setdefault(reason, []).append(f.key)
    return "".join(f"\nNCI of {', '.join(k)} is –: {why}." for why, k in by_reason.items())


def _needed(contest: Contest, precision: float) -> Table:
    units = tuple(a.unit for a in contest.findings[0].accuracy)
    return tabulate(
        f"Runs needed for NEES/n ± {precision:g}, RMSE ± {precision:.2g} of it",
        ("<estimator", "NEES/n", *(f"RMSE, {unit}" for unit in units)),
        tuple(
            (f.key, *(_count(x) for x in (f.anees_needed, *(a.needed for a in f.accuracy))))
            for f in contest.findings
        ),
    )


def _count(x: int | None) -> str:
    return "–" if x is None else str(x)
