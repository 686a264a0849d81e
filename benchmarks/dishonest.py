"""Estimators that are broken or lie, and what is said of each: `python -m benchmarks.dishonest`.

Each is an EKF of which one method does something wrong. It runs on the pendulum; the table says by
which message it was named. One whose numbers agree with each other, and are wrong as a statistic
only, is for the verdict to judge. None whose numbers contradict each other may be called consistent
without a word.
"""

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np

from estbench.errors import EstbenchError
from estbench.estimators.ekf import EKF
from estbench.montecarlo.run import run

Expected = Literal["named", "verdict", "harmless"]
EXPECTED: dict[str, Expected] = {}
"""Name -> whether it must be named, is the verdict's task, or does no harm."""


def add(name: str, expected: Expected, **methods: Callable[..., Any]) -> None:
    """Make a class of this module: an EKF with other methods."""
    EXPECTED[name] = expected
    globals()[name] = type(name, (EKF,), {"__module__": __name__, **methods})


def cov(change: Callable[[Any], Any]) -> dict[str, Callable[..., Any]]:
    """A method `cov` that changes what is right."""
    return {"cov": lambda self, belief: change(belief.cov)}


def mean(change: Callable[[Any], Any]) -> dict[str, Callable[..., Any]]:
    """A method `mean` that changes what is right."""
    return {"mean": lambda self, belief: change(belief.mean)}


def innovation(**changes: Callable[[Any], Any]) -> dict[str, Callable[..., Any]]:
    """A method `update` that changes fields of the innovation."""

    def update(self: Any, *arguments: Any, **options: Any) -> Any:
        belief, v = EKF.update(self, *arguments, **options)
        return belief, replace(v, **{name: change(v) for name, change in changes.items()})

    return {"update": update}


def update(change: Callable[..., Any]) -> dict[str, Callable[..., Any]]:
    """A method `update` whose answer, or whose belief, is another: change(self, answer, y, t)."""

    def method(self: Any, belief: Any, y: Any, u: Any, t: float, *more: Any, **options: Any) -> Any:
        return change(self, EKF.update(self, belief, y, u, t, *more, **options), y, t)

    return {"update": method}


def predict(change: Callable[..., Any]) -> dict[str, Callable[..., Any]]:
    """A method `predict` whose belief is another: change(self, prior, posterior, t)."""

    def method(self: Any, belief: Any, u: Any, t: float, dt: float) -> Any:
        return change(self, EKF.predict(self, belief, u, t, dt), belief, t)

    return {"predict": method}


def fail(error: BaseException, since: float = -1.0) -> Callable[..., Any]:
    """A change that raises from a time on."""

    def change(self: Any, answer: Any, other: Any, t: float) -> Any:
        if t > since:
            raise error
        return answer

    return change


def entry(cov: Any, size: float, run: slice | int = slice(None)) -> Any:
    """P with its entry [0, 1] changed by a share of σ₀ σ₁."""
    out = cov.copy()
    out[run, 0, 1] += size * np.sqrt(cov[run, 0, 0] * cov[run, 1, 1])
    return out


def put(array: Any, value: Any, *place: Any) -> Any:
    """The array with another value at a place, in place."""
    array[place] = value
    return array


def other(belief: Any, **fields: Any) -> Any:
    """A belief with other fields."""
    return replace(belief, **fields)


def counted(self: Any) -> int:
    """How often it was called on this object: a state outside of the belief."""
    object.__setattr__(self, "calls", getattr(self, "calls", 0) + 1)
    return self.calls


def stored(self: Any, y: Any) -> Any:
    """The reading of the last call: a state outside of the belief."""
    last = getattr(self, "last", y)
    object.__setattr__(self, "last", y.copy())
    return last


# The covariance
add("CovTooSmall", "verdict", **cov(lambda P: P / 4))
add("CovTooLarge", "verdict", **cov(lambda P: P * 4))
add("CovIsStd", "verdict", **cov(lambda P: np.sqrt(np.abs(P)) * np.eye(P.shape[-1])))
add("CovDiagonal", "verdict", **cov(lambda P: P * np.eye(P.shape[-1])))
add("CovConstant", "verdict", **cov(lambda P: np.broadcast_to(0.01 * np.eye(P.shape[-1]), P.shape)))
add("CovFloat32", "harmless", **cov(lambda P: P.astype(np.float32)))
add("CovList", "harmless", **cov(lambda P: P.tolist()))
add("CovAsymmetric", "named", **cov(lambda P: entry(P, 0.3)))
add("CovHardlyAsymmetric", "named", **cov(lambda P: entry(P, 1e-4)))
add("CovAsymmetricInOneRun", "named", **cov(lambda P: entry(P, 0.3, 1)))
add("CovTriangular", "named", **cov(np.tril))
add("CovNegative", "named", **cov(lambda P: -P))
add("CovIndefinite", "named", **cov(lambda P: P - 2 * P[:, :1, :1] * np.eye(P.shape[-1])))
add("CovNaN", "named", **cov(lambda P: P * np.nan))
add("CovInfinite", "named", **cov(lambda P: np.full_like(P, np.inf)))
add("CovComplex", "named", **cov(lambda P: P + 1e-9j))
add("CovMasked", "named", **cov(lambda P: np.ma.masked_less(P, 0)))
add("CovObjects", "named", **cov(lambda P: P.astype(object)))
add("CovOfOneRun", "named", **cov(lambda P: P[0]))
add("CovWrongAxes", "named", **cov(lambda P: np.moveaxis(P, 0, -1)))
add("CovNone", "named", **cov(lambda P: None))
# The estimate
add("MeanShifted", "verdict", **mean(lambda x: x + 0.1))
add("MeanRounded", "verdict", **mean(lambda x: np.round(x, 1)))
add("MeanStuck", "verdict", **update(lambda self, answer, y, t: answer) | mean(lambda x: 0 * x))
add("MeanComplex", "named", **mean(lambda x: x + 0j))
add("MeanMasked", "named", **mean(lambda x: np.ma.masked_greater(x, 1e9)))
add("MeanText", "named", **mean(lambda x: x.astype(str)))
add("MeanFlat", "named", **mean(lambda x: x.ravel()))
add("MeanOfAll", "named", **mean(lambda x: x.mean(axis=0) + 0 * x))
add(
    "MeanNaNLater",
    "named",
    **predict(
        lambda self, prior, _, t: prior if t < 0.1 else other(prior, mean=prior.mean * np.nan)
    ),
)
add(
    "MeanNaNInOneRun",
    "named",
    **predict(
        lambda self, prior, _, t: (
            prior if t < 0.1 else other(prior, mean=put(prior.mean.copy(), np.nan, 1))
        )
    ),
)
# The innovation
add("NisNegative", "named", **innovation(nis=lambda v: -v.nis))
add("NisNaN", "named", **innovation(nis=lambda v: v.nis * np.nan))
add("NisInfinite", "named", **innovation(nis=lambda v: v.nis + np.inf))
add("NisIsOne", "named", **innovation(nis=lambda v: 0 * v.nis + v.dof))
add("NisDoubled", "named", **innovation(nis=lambda v: 2 * v.nis))
add("NisOfOneRunWrong", "named", **innovation(nis=lambda v: put(v.nis.copy(), 1.0, 1)))
add("NisComplex", "named", **innovation(nis=lambda v: v.nis + 0j))
add("NisMasked", "named", **innovation(nis=lambda v: np.ma.masked_less(v.nis, 0)))
add("NisNumber", "named", **innovation(nis=lambda v: float(v.nis[0])))
add("NisOfAnotherS", "named", **innovation(cov=lambda v: 4 * v.cov))
add("SAsymmetric", "named", **innovation(cov=lambda v: entry(v.cov, 0.3)))
add("SNegative", "named", **innovation(cov=lambda v: -v.cov))
add("ResidualDoubled", "named", **innovation(residual=lambda v: 2 * v.residual))
add("WhiteIsResidual", "named", **innovation(white=lambda v: v.residual))
add("WhiteComplex", "named", **innovation(white=lambda v: v.white + 0j))
add("WhiteShort", "named", **innovation(white=lambda v: v.white[:, :1]))
add("DofNegative", "named", **innovation(dof=lambda v: -v.dof))
add("DofTooLarge", "named", **innovation(dof=lambda v: 10 * v.dof))
add(
    "InnovationScaled",
    "verdict",
    **innovation(cov=lambda v: 4 * v.cov, nis=lambda v: v.nis / 4, white=lambda v: v.white / 2),
)
add("InnovationMissing", "named", **update(lambda self, answer, y, t: answer[0]))
add("InnovationDictionary", "named", **update(lambda self, answer, y, t: (answer[0], {"nis": 0})))
add("UpdateNone", "named", **update(lambda self, answer, y, t: None))
add(
    "InnovationOnlyNis",
    "harmless",
    **update(
        lambda self, answer, y, t: (
            answer[0],
            SimpleNamespace(nis=answer[1].nis, dof=answer[1].dof, white=np.empty((len(y), 0))),
        )
    ),
)
# Purity
add(
    "HiddenCount",
    "named",
    **update(
        lambda self, answer, y, t: (
            other(answer[0], cov=answer[0].cov * (1 + 0.01 * counted(self))),
            answer[1],
        )
    ),
)
add(
    "HiddenCountLater",
    "named",
    **update(
        lambda self, answer, y, t: (
            other(answer[0], cov=answer[0].cov * (2 if counted(self) > 4 else 1)),
            answer[1],
        )
    ),
)
add(
    "HiddenReading",
    "named",
    **update(
        lambda self, answer, y, t: (
            other(answer[0], mean=answer[0].mean + 0.01 * (y - stored(self, y))[:, :1]),
            answer[1],
        )
    ),
)
add("CallsCounted", "harmless", **update(lambda self, answer, y, t: (counted(self), answer)[1]))
add(
    "UnseededNoise",
    "named",
    **predict(
        lambda self, prior, _, t: other(
            prior,
            mean=prior.mean + 1e-3 * np.random.default_rng().standard_normal(prior.mean.shape),
        )
    ),
)
add(
    "UnseededStart",
    "named",
    init=lambda self, mean, cov: EKF.init(
        self, mean + 1e-3 * np.random.default_rng().standard_normal(mean.shape), cov
    ),
)
add(
    "PredictsInPlace",
    "named",
    **predict(lambda self, prior, posterior, t: (put(posterior.mean, prior.mean, ...), prior)[1]),
)
add(
    "UpdatesInPlace",
    "named",
    update=lambda self, belief, *more, **options: (
        put(belief.cov, 1.01 * belief.cov, ...),
        EKF.update(self, belief, *more, **options),
    )[1],
)
add("ReadingInPlace", "named", **update(lambda self, answer, y, t: (put(y, 0.0, ...), answer)[1]))
add(
    "PriorInPlace",
    "named",
    init=lambda self, mean, cov: EKF.init(self, mean, put(cov, 2 * cov, ...)),
)
add(
    "RunsMixed",
    "named",
    **predict(
        lambda self, prior, _, t: other(
            prior, mean=0.9 * prior.mean + 0.1 * prior.mean.mean(axis=0)
        )
    ),
)
# The start
add("StartElsewhere", "verdict", init=lambda self, mean, cov: EKF.init(self, mean + 1.0, cov))
add("StartTooSure", "verdict", init=lambda self, mean, cov: EKF.init(self, mean, 1e-4 * cov))
add("StartOfOneRun", "named", init=lambda self, mean, cov: EKF.init(self, mean[:1], cov[:1]))
add(
    "PriorForEver",
    "verdict",
    **predict(lambda self, prior, posterior, t: posterior)
    | update(
        lambda self, answer, y, t: (EKF.init(self, 0 * answer[0].mean, answer[0].cov), answer[1])
    ),
)
# Exceptions
add("RaisesInStart", "named", init=lambda self, mean, cov: mean.no_such_thing)
add("RaisesKeyError", "named", **predict(fail(KeyError("gain"))))
add("RaisesZeroDivision", "named", **update(fail(ZeroDivisionError("gain"))))
add("RaisesLater", "named", **predict(fail(np.linalg.LinAlgError("singular"), 0.1)))
add("RaisesAssertion", "named", **update(fail(AssertionError())))
add("RaisesStopIteration", "named", **update(fail(StopIteration())))
add("RaisesRecursion", "named", **predict(fail(RecursionError("too deep"))))
add("Exits", "named", **update(fail(SystemExit(3))))
add("RaisesInCov", "named", **cov(lambda P: np.linalg.inv(0 * P)))
add("TakesNoChannels", "named", update=lambda self, belief, y: EKF.update(self, belief, y, y, 0.0))


@dataclass(frozen=True)
class Said:
    """What was said of an estimator.

    Attributes:
        outcome: `named` by an error or as the fault of a run, otherwise `verdict`.
        text: the message, or the verdict.
    """

    outcome: Literal["named", "verdict"]
    text: str


def said(name: str, runs: int, duration: float) -> Said:
    """Run one of them on the pendulum."""
    try:
        results = run("pendulum", [globals()[name]], runs=runs, duration=duration)
    except EstbenchError as error:
        return Said("named", str(error))
    (summary,) = results.summaries
    if summary.failures:
        first = summary.failures[0]
        return Said(
            "named",
            f"{len(summary.failures)} of {runs} runs failed, the first at {first.time:.2f} s: "
            f"{first.reason}",
        )
    return Said("verdict", str(summary.verdict))


def main() -> None:
    """Print the table; exit code 1 if one that must be named was not."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--duration", type=float, default=0.5, help="s")
    parser.add_argument("--only", nargs="+", choices=list(EXPECTED), default=list(EXPECTED))
    args = parser.parse_args()
    missed = []
    print("| estimator | outcome | message or verdict |\n|---|---|---|")
    for name in args.only:
        found, expected = said(name, args.runs, args.duration), EXPECTED[name]
        if (found.outcome == "named") != (expected == "named"):
            missed.append(name)
        outcome = found.outcome
        if outcome != "named":
            outcome = "harmless" if expected == "harmless" else "judged by the verdict"
        print(f"| `{name}` | {outcome} | {found.text} |", flush=True)
    print(
        f"\n{len(args.only)} estimators, {len(missed)} not as expected: {', '.join(missed) or '-'}"
    )
    sys.exit(bool(missed))


if __name__ == "__main__":
    main()
