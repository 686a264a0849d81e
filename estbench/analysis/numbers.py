"""The numbers of a comparison in full: nested for JSON, one a row for CSV."""

import csv
import io
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

from estbench.analysis.compare import Comparison, Contest
from estbench.analysis.comparison import Paired
from estbench.analysis.findings import Findings
from estbench.consistency.coverage import SIGMAS
from estbench.consistency.nees import Interval


def to_dict(comparison: Comparison) -> dict[str, Any]:
    """Plain numbers; one that is not finite becomes None."""
    return {
        "level": comparison.level,
        "margin": comparison.margin,
        "precision": comparison.precision,
        "contests": [
            {
                "scenario": c.stores[0].scenario.name,
                "seed": c.stores[0].scenario.simulation.seed,
                "runs": len(c.runs),
                "folders": [
                    {"folder": str(s.folder), "runs": len(s.runs), "wanted": s.total,
                     "versions": s.attrs.get("versions"),
                     "continued": s.attrs.get("continued", [])}
                    for s in c.stores
                ],
                "estimators": {f.key: _estimator(f) for f in c.findings},
                "ranking": [
                    {"estimator": r.key, "rank": r.place, "last_rank": r.last, "tied": r.tied,
                     "rmse_ratio_to_first": _plain(r.ratio), "lost_share": r.lost}
                    for r in c.ranks
                ],
                "pairs": [
                    {
                        "a": p.a,
                        "b": p.b,
                        "rmse_ratio": _plain(p.ratio),
                        **_tests(p.paired),
                        "sign_p_holm": p.sign,
                        "wilcoxon_p_holm": p.wilcoxon,
                        "differ": p.differ,
                        "rmse_difference": {
                            name: {"unit": unit, **_plain(d.difference), **_tests(d)}
                            for name, unit, d in zip(c.stores[0].names, c.stores[0].units, rmse)
                        },
                        "nees_over_n_difference": {**_plain(nees.difference), **_tests(nees)},
                    }
                    for p, (rmse, nees) in zip(c.pairs, c.details())
                ],
            }
            for c in comparison.contests
        ],
    }  # fmt: skip


def _estimator(f: Findings) -> dict[str, Any]:
    s = f.summary
    coverage = f.coverage or (None,) * len(s.rmse)
    white = f.whiteness
    return {
        "folder": str(f.stored.folder),
        "label": f.label,
        "runs": s.runs,
        "verdict": str(s.verdict),
        "anees_over_n": {
            **_plain(s.anees),
            "trimmed": _plain(f.anees_trimmed),
            "median": _plain(f.anees_median),
        },
        "anis_over_m": _plain(s.anis),
        "innovation_lag_one": _plain(s.lag_one),
        "diverged_share": _plain(s.diverged_interval),
        "cost_us_per_run_step": _number(s.cost),
        "rmse": {
            name: {
                "unit": unit, **_plain(i), "median": _number(m), "sigma": _number(d),
                "coverage": None if c is None else [_plain(x) for x in c.shares],
            }
            for name, unit, i, m, d, c in zip(
                f.stored.names, f.stored.units, s.rmse, s.rmse_median, s.std, coverage
            )
        },
        "rmse_by_unit": {
            a.unit: {
                "coordinates": list(a.names), **_plain(a.mean), "trimmed": _plain(a.trimmed),
                "median": _plain(a.median), "sigma": _number(a.sigma), "runs_needed": a.needed,
                "coverage": None if a.coverage is None else [_plain(x) for x in a.coverage.shares],
            }
            for a in f.accuracy
        },
        "runs_needed_anees": f.anees_needed,
        "whiteness": None if white is None else {
            "correlation": [_plain(i) for i in white.correlation],
            "rejected_share": _plain(white.rejected),
            "pooled_p": _number(white.p),
        },
        "nci_db": None if f.nci is None else {
            "value": _number(f.nci), "expected": _number(f.nci_expected or np.nan),
            "inclination": _number(f.inclination or 0.0),
        },
    }  # fmt: skip


def _tests(p: Paired) -> dict[str, Any]:
    return {
        "runs": p.runs, "less": p.less, "more": p.more, "ties": p.ties,
        "sign_p": p.sign, "wilcoxon_p": p.wilcoxon, "effect": p.effect,
    }  # fmt: skip


def _plain(i: Interval) -> dict[str, float | None]:
    return {"value": _number(i.value), "low": _number(i.low), "high": _number(i.high)}


def _number(x: float) -> float | None:
    return float(x) if np.isfinite(x) else None


COLUMNS: tuple[str, ...] = (
    "scenario", "seed", "estimator", "against", "quantity", "coordinate", "unit",
    "value", "low", "high", "p_sign", "p_wilcoxon",
)  # fmt: skip


def to_csv(comparison: Comparison) -> str:
    """One number a row, with its interval; an empty cell where there is none."""
    file = io.StringIO()
    writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
    writer.writeheader()
    for contest in comparison.contests:
        scenario = contest.stores[0].scenario
        common = {"scenario": scenario.name, "seed": scenario.simulation.seed}
        for row in (*_estimator_rows(contest), *_pair_rows(contest)):
            values = {k: "" if v is None else v for k, v in row.items()}
            writer.writerow({**common, **values})
    return file.getvalue()


def _estimator_rows(contest: Contest) -> Iterator[dict[str, Any]]:
    for f in contest.findings:
        found = _estimator(f)

        row = partial(_row, f.key)
        yield row("verdict", found["verdict"])
        for name in ("runs", "anees_over_n", "anis_over_m", "innovation_lag_one", "diverged_share"):
            yield row(name, found[name])
        yield row("cost", found["cost_us_per_run_step"], unit="us/run-step")
        for table, kind in (("rmse", "rmse"), ("rmse_by_unit", "rmse_norm")):
            for name, r in found[table].items():
                unit = r.get("unit", name)
                where = name if table == "rmse" else " ".join(r["coordinates"])
                yield row(kind, r, where, unit)
                yield row(f"{kind}_median", r["median"], where, unit)
                if "trimmed" in r:
                    yield row(f"{kind}_trimmed", r["trimmed"], where, unit)
                yield row(f"{kind}_sigma", r["sigma"], where, unit)
                for k, share in zip(SIGMAS, r["coverage"] or ()):
                    yield row(f"{kind}_coverage_{k}_sigma", share, where)
        if (white := found["whiteness"]) is not None:
            yield row("not_white_share", white["rejected_share"])
            yield row("not_white_pooled_p", white["pooled_p"])
        if (nci := found["nci_db"]) is not None:
            yield row("nci", nci["value"], unit="dB")
            yield row("nci_expected", nci["expected"], unit="dB")
            yield row("inclination", nci["inclination"], unit="dB")
    for r in contest.ranks:
        yield {"estimator": r.key, "quantity": "rank", "value": r.place, "low": r.place,
               "high": r.last}  # fmt: skip


def _row(
    estimator: str, quantity: str, value: Any, coordinate: str = "", unit: str = ""
) -> dict[str, Any]:
    plain = value if isinstance(value, dict) else {"value": value}
    return {
        "estimator": estimator, "quantity": quantity, "coordinate": coordinate, "unit": unit,
        **{k: plain.get(k) for k in ("value", "low", "high")},
    }  # fmt: skip


def _pair_rows(contest: Contest) -> Iterator[dict[str, Any]]:
    names, units = contest.stores[0].names, contest.stores[0].units
    for p, (rmse, nees) in zip(contest.pairs, contest.details()):
        pair = {"estimator": p.a, "against": p.b}
        tests = {"p_sign": p.sign, "p_wilcoxon": p.wilcoxon}
        yield {**pair, "quantity": "rmse_ratio", **_plain(p.ratio), **tests}
        differences = [("rmse_difference", n, u, d) for n, u, d in zip(names, units, rmse)]
        for quantity, name, unit, d in (*differences, ("nees_over_n_difference", "", "", nees)):
            yield {**pair, "quantity": quantity, "coordinate": name, "unit": unit,
                   **_plain(d.difference), "p_sign": d.sign, "p_wilcoxon": d.wilcoxon}  # fmt: skip
