"""All numbers of a comparison: nested for JSON, one per row for CSV."""

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

from estbench.analysis.compare import Comparison, Contest
from estbench.analysis.comparison import Paired
from estbench.analysis.findings import Findings
from estbench.consistency import statistics
from estbench.consistency.coverage import SIGMAS, Coverage
from estbench.consistency.declaration import Statistic
from estbench.consistency.phases import SHOWN
from estbench.consistency.statistics import ANEES, ANEES_MEDIAN, RMSE
from estbench.tables import phases, writers
from estbench.tables.cells import per_coordinate, plain, value_of


def to_dict(comparison: Comparison) -> dict[str, Any]:
    """Plain numbers for JSON; None where a number is not finite."""
    return {
        "level": comparison.level,
        "margin": comparison.margin,
        "precision": comparison.precision,
        "contests": [
            {
                "scenario": c.stores[0].scenario.name,
                "seed": c.stores[0].scenario.simulation.seed,
                "runs": len(c.runs),
                "score": "rmse" if c.truth else "density",
                "folders": [
                    {"folder": str(s.folder), "runs": len(s.runs), "wanted": s.total,
                     "versions": s.attrs.get("versions"),
                     "continued": s.attrs.get("continued", [])}
                    for s in c.stores
                ],
                "estimators": {f.key: _estimator(f) for f in c.findings},
                "ranking": [
                    {"estimator": r.key, "rank": r.place, "last_rank": r.last, "tied": r.tied,
                     f"{_score(c)}_to_first": plain(r.ratio), "lost_share": r.lost}
                    for r in c.ranks
                ],
                "pairs": [
                    {
                        "a": p.a,
                        "b": p.b,
                        _score(c): plain(p.ratio),
                        **_tests(p.paired),
                        "sign_p_holm": p.sign,
                        "wilcoxon_p_holm": p.wilcoxon,
                        "differ": p.differ,
                        "rmse_difference": {
                            name: {"unit": unit, **plain(d.difference), **_tests(d)}
                            for name, unit, d in zip(c.stores[0].names, c.stores[0].units, rmse)
                        },
                        "nees_over_n_difference": {**plain(nees.difference), **_tests(nees)},
                        "log_likelihood_difference": plain(likely),
                    }
                    for p, (rmse, nees), likely in zip(c.pairs, c.details(), c.log_likelihood)
                ],
            }
            for c in comparison.contests
        ],
    }  # fmt: skip


def _score(contest: Contest) -> str:
    """The name of a ratio of scores: of errors, or of inverse densities of the readings."""
    return "rmse_ratio" if contest.truth else "inverse_density_ratio"


def _estimator(f: Findings) -> dict[str, Any]:
    s, white = f.summary, f.whiteness
    # The median of NEES/n, with its interval, is in the object of the mean.
    runs = {x.json_key: plain(value_of(s, x)) for x in _of_runs()}
    runs[ANEES.json_key] |= {"trimmed": plain(f.anees_trimmed), "median": plain(f.anees_median)}
    names, units = f.stored.names, f.stored.units
    coordinates = per_coordinate(s, statistics.of("coordinate"), names, units)
    for name, found in zip(names, f.coverage or (None,) * len(names)):
        shares = None if found is None else [plain(x) for x in found.shares]
        coordinates[RMSE.json_key][name]["coverage"] = shares
    return {
        "folder": str(f.stored.folder),
        "label": f.label,
        "runs": s.runs,
        "verdict": str(s.verdict),
        "reason": s.reason,
        **runs,
        **coordinates,
        "rmse_by_unit": {
            a.unit: {
                "coordinates": list(a.names), **plain(a.mean), "trimmed": plain(a.trimmed),
                "median": plain(a.median), "sigma": plain(a.sigma), "runs_needed": a.needed,
                "coverage": None if a.coverage is None else [plain(x) for x in a.coverage.shares],
            }
            for a in f.accuracy
        },
        "phases": phases.numbers(f.phases),
        "runs_needed_anees": f.anees_needed,
        "whiteness": None if white is None else {
            "correlation": [plain(i) for i in white.correlation],
            "rejected_share": plain(white.rejected),
            "pooled_p": plain(white.p),
        },
        "nci_db": None if f.nci is None else {
            "value": plain(f.nci), "expected": plain(f.nci_expected or np.nan),
            "inclination": plain(f.inclination or 0.0),
        },
    }  # fmt: skip


def _of_runs() -> list[Statistic]:
    """The statistics with one value per estimator, without the median of NEES/n."""
    return [s for s in statistics.of("run") if s is not ANEES_MEDIAN]


def _tests(p: Paired) -> dict[str, Any]:
    return {
        "runs": p.runs, "less": p.less, "more": p.more, "ties": p.ties,
        "sign_p": p.sign, "wilcoxon_p": p.wilcoxon, "effect": p.effect,
    }  # fmt: skip


COLUMNS: tuple[str, ...] = (
    "scenario", "seed", "estimator", "against", "quantity", "coordinate", "unit",
    "value", "low", "high", "p_sign", "p_wilcoxon",
)  # fmt: skip


def to_csv(comparison: Comparison) -> str:
    """One number per row, with its interval; an empty cell where there is none."""
    rows = []
    for contest in comparison.contests:
        scenario = contest.stores[0].scenario
        common = {"scenario": scenario.name, "seed": scenario.simulation.seed}
        for row in (*_estimator_rows(contest), *_pair_rows(contest)):
            rows.append(common | {k: "" if v is None else v for k, v in row.items()})
    return writers.comma_separated(COLUMNS, rows)


def _estimator_rows(contest: Contest) -> Iterator[dict[str, Any]]:
    for f in contest.findings:
        s, row = f.summary, partial(_row, f.key)
        yield row("verdict", str(s.verdict))
        yield row("runs", s.runs)
        for x in _of_runs():
            yield row(x.key, plain(value_of(s, x)), unit="" if x.unit == "1" else x.unit)
        yield from _coordinate_rows(f)
        for a in f.accuracy:
            where = " ".join(a.names)
            for end, value in (
                ("", a.mean), ("_median", a.median), ("_trimmed", a.trimmed), ("_sigma", a.sigma),
            ):  # fmt: skip
                yield row(f"rmse_norm{end}", plain(value), where, a.unit)
            yield from _coverage_rows(f.key, "rmse_norm", where, a.coverage)
        for phase in f.phases:
            yield row(f"share_{phase.name}", phase.share)
            for x, value in zip(SHOWN.values(), phase.values):
                yield row(f"{x.key}_{phase.name}", plain(value))
            for unit, value in phase.rmse.items():
                yield row(f"rmse_norm_{phase.name}", plain(value), unit=unit)
        if f.whiteness is not None:
            yield row("not_white_share", plain(f.whiteness.rejected))
            yield row("not_white_pooled_p", plain(f.whiteness.p))
        if f.nci is not None:
            yield row("nci", plain(f.nci), unit="dB")
            yield row("nci_expected", plain(f.nci_expected or np.nan), unit="dB")
            yield row("inclination", plain(f.inclination or 0.0), unit="dB")
    for r in contest.ranks:
        yield {"estimator": r.key, "quantity": "rank", "value": r.place, "low": r.place,
               "high": r.last}  # fmt: skip


def _coordinate_rows(f: Findings) -> Iterator[dict[str, Any]]:
    """The statistics of each coordinate, then its coverage."""
    names, units = f.stored.names, f.stored.units
    for i, (name, unit) in enumerate(zip(names, units)):
        for s in statistics.of("coordinate"):
            value = plain(value_of(f.summary, s)[i])
            yield _row(f.key, s.key.replace(".", "_"), value, name, s.unit.replace("[c]", unit))
        found = f.coverage[i] if f.coverage is not None else None
        yield from _coverage_rows(f.key, RMSE.key, name, found)


def _coverage_rows(
    estimator: str, kind: str, where: str, found: Coverage | None
) -> Iterator[dict[str, Any]]:
    for k, share in zip(SIGMAS, found.shares if found is not None else ()):
        yield _row(estimator, f"{kind}_coverage_{k}_sigma", plain(share), where)


def _row(
    estimator: str, quantity: str, value: Any, coordinate: str = "", unit: str = ""
) -> dict[str, Any]:
    found = value if isinstance(value, dict) else {"value": value}
    return {
        "estimator": estimator, "quantity": quantity, "coordinate": coordinate, "unit": unit,
        **{k: found.get(k) for k in ("value", "low", "high")},
    }  # fmt: skip


def _pair_rows(contest: Contest) -> Iterator[dict[str, Any]]:
    names, units = contest.stores[0].names, contest.stores[0].units
    for p, (rmse, nees), likely in zip(contest.pairs, contest.details(), contest.log_likelihood):
        pair = {"estimator": p.a, "against": p.b}
        tests = {"p_sign": p.sign, "p_wilcoxon": p.wilcoxon}
        yield {**pair, "quantity": _score(contest), **plain(p.ratio), **tests}
        differences = [("rmse_difference", n, u, d) for n, u, d in zip(names, units, rmse)]
        for quantity, name, unit, d in (*differences, ("nees_over_n_difference", "", "", nees)):
            yield {
                **pair,
                "quantity": quantity,
                "coordinate": name,
                "unit": unit,
                **plain(d.difference),
                "p_sign": d.sign,
                "p_wilcoxon": d.wilcoxon,
            }
        yield {**pair, "quantity": "log_likelihood_difference", **plain(likely)}  # fmt: skip
