"""An estimator through measurements that are given: no robot, no sensors, no event loop."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from estbench.consistency.whiteness import Whiteness, whiteness
from estbench.errors import DimensionError, EstbenchError, EstimatorError, user_error_location
from estbench.estimators.beliefs import checked_keys, start
from estbench.estimators.protocol import Estimator, FilterHistory, Measurement
from estbench.inference.answers import Answers, kept
from estbench.inference.innovations import Innovations
from estbench.inference.priors import checked_prior, real
from estbench.inference.probe import probe_estimator
from estbench.inference.run_subset import ALL
from estbench.models.probe import probe
from estbench.models.protocol import Model
from estbench.shapes import Array, Float, Int, Ints, Keys, UInt
from estbench.spaces.blas import one_thread
from estbench.spaces.linalg import quiet
from estbench.spaces.manifold import Manifold

Keep = Literal["beliefs", "moments", "last"]
_CHANNEL = ("y",)
_KEPT = ("innovation", "innovation_cov")


@dataclass(frozen=True, eq=False)
class Followed(FilterHistory):
    """The history of `follow`, as a smoother takes it, and the innovations.

    Attributes:
        index: the place in `times` of each time that was given; equal times are one.
        nis: νᵀ S⁻¹ ν summed over what was fused at each time; NaN where nothing arrived.
        dof: how many components arrived.
        innovation: ν; NaN where nothing arrived, of two readings at one time the last. None if only
            the last belief is kept.
        innovation_cov: S, likewise.
        lags: sums of ν̃ₖ·ν̃ₖ₋ₗ of each run, l = 0, 1, ..., of the whitened innovations ν̃.
        lag_terms: how many products are in each.
        fault: `Fault` of each run that the checks of the estimator's answers found.
        mean: x̂ with `keep="moments"`, else None.
        cov: P, likewise.
    """

    index: Int[Ints, " given"]
    nis: Float[Array, "time run"]
    dof: Int[Ints, "time run"]
    innovation: Float[Array, "time run m"] | None
    innovation_cov: Float[Array, "time run m m"] | None
    lags: Float[Array, "run lag"]
    lag_terms: Int[Ints, "run lag"]
    fault: UInt[Any, " run"]
    mean: Float[Array, "time run nx"] | None = None
    cov: Float[Array, "time run n n"] | None = None

    def whiteness(self, level: float = 0.95) -> Whiteness | None:
        """Ljung and Box's test of the innovations; None where no run has two of them."""
        return whiteness(self.lags, self.lag_terms, level)


def follow(
    estimator: Estimator,
    mean: Float[Array, "run nx"],
    cov: Float[Array, "run n n"],
    y: ArrayLike,
    *,
    u: ArrayLike | None = None,
    times: ArrayLike | None = None,
    keys: UInt[Keys, " run"] | None = None,
    keep: Keep = "beliefs",
) -> Followed:
    """Predict to each time and update with what was measured then.

    From the belief N(mean, cov) at times[0], for k = 0, 1, ..., K - 1: the prediction from times[k]
    to times[k + 1] under u[k], then the update with y[k] (source 001, eq. 1-2). Between equal times
    nothing is predicted: their readings are fused one after the other. With K + 1 measurements the
    first is of times[0] and is fused with the prior.

    The model and a user's own estimator are tried first (`models.probe`, `inference.probe`), and
    what the estimator returns is checked at every step (`inference.answers`).

    Args:
        estimator: any object of the protocol, over any model whose measurements are real numbers.
        mean: x̂₀.
        cov: P₀.
        y: measurements `(K, run, ny)` at times[1], ..., times[K], or `(K + 1, run, ny)` with one at
            times[0]; NaN where none arrived.
        u: controls `(K, run, nu)`, each held to the next time; default 0.
        times: `(K + 1,)` in s, none before the last; default 0, 1, ..., K for K measurements.
        keys: a random key per run for estimators whose `init` takes `keys`.
        keep: `beliefs` keeps all of them, which a smoother needs; `moments` x̂ and P of each time
            and the last belief; `last` the last belief. Controls and measurements are kept with
            all beliefs only, ν and S unless only the last belief is kept.

    Returns:
        The beliefs at each different time, with all that a smoother needs
        (`estimator.smooth(history)`), and the innovations.

    Raises:
        DimensionError: y, u or times do not fit each other or the prior, times fall, or the prior
            is not finite.
        CovarianceError: P₀ is not symmetric positive semidefinite.
        ModelError, EstimatorError: the model, or the estimator, is refused when it is tried.
    """
    if keep not in ("beliefs", "moments", "last"):
        raise EstimatorError(f"keep is {keep!r}; use 'beliefs', 'moments' or 'last'")
    model = getattr(estimator, "model", None)
    model = model if isinstance(model, Model) else None
    mean, cov = checked_prior(mean, cov, None if model is None else model.space)
    y = real("y is", y, "(step, run, ny)")
    u = None if u is None else real("u is", u, "(step, run, nu)")
    for name, given in (("y", y), ("u", u)):
        if given is not None and not given.ndim:
            raise DimensionError(f"{name} is {given!r}; expected an array (step, run, ...)")
    ny, nu = y.shape[-1], 0 if u is None else u.shape[-1]
    if model is not None:
        ny, nu = model.output().nx, model.nu
    if y.ndim != 3 or y.shape[1:] != (len(mean), ny):
        raise DimensionError(f"y has shape {y.shape}; expected (step, {len(mean)}, {ny})")
    clock = _times(times, len(y))
    count, runs = len(clock) - 1, len(mean)
    keys = None if keys is None else checked_keys(keys, runs)
    controls = np.zeros((count, runs, nu)) if u is None else u
    if controls.shape != (count, runs, nu):
        raise DimensionError(
            f"u has shape {controls.shape}; expected {(count, runs, nu)}, one control for each "
            f"interval of the {count + 1} times"
        )
    readings = y if len(y) == len(clock) else np.concatenate([np.full((1, runs, ny), np.nan), y])
    if model is not None and count:
        probe(model, mean, cov, controls[0], clock.tolist())
    space = Manifold.euclidean(ny) if model is None else model.output()
    answers = Answers(estimator)
    passage = _Passage(estimator, answers, clock, readings, controls, keep)
    try:
        with quiet(), one_thread():  # failed runs are marked
            if not answers.own:
                passage.probe(mean, cov, keys, space.n)
            sizes = mean.shape[-1], cov.shape[-1]
            return passage.history(start(estimator, mean, cov, keys), space, sizes)
    except (EstbenchError, MemoryError):
        raise
    except (Exception, SystemExit) as error:  # a user's estimator may raise anything
        raise EstimatorError(f"{answers.name} raised {user_error_location(error)}") from error


def _times(given: ArrayLike | None, steps: int) -> Array:
    """The times, one more than there are steps, or as many.

    Raises:
        DimensionError: their count does not fit, or one is before the one before it.
    """
    clock = real("times is", range(steps + 1) if given is None else given, "seconds")
    if clock.ndim != 1 or len(clock) not in (steps, steps + 1) or not len(clock):
        raise DimensionError(
            f"times has shape {clock.shape}; expected {steps + 1} rising numbers, one more than y "
            f"has steps, or {steps} with a measurement at the first"
        )
    wrong = np.flatnonzero(~(np.diff(clock) >= 0))
    if len(wrong):
        before, after = clock[wrong[0] : wrong[0] + 2]
        raise DimensionError(
            f"times[{wrong[0]}] is {before:g} and the next {after:g}; give times in s that do not "
            "fall"
        )
    return clock


@dataclass(frozen=True, eq=False)
class _Passage:
    """What is given: one reading for each time of `clock` `(time, run, ny)`, NaN for none."""

    estimator: Estimator
    answers: Answers
    clock: Array
    readings: Array
    controls: Array
    keep: Keep

    def control(self, k: int) -> Array:
        """The control up to the k-th time, or at the first."""
        none = np.zeros((self.readings.shape[1], self.controls.shape[-1]))
        return self.controls[max(k - 1, 0)] if len(self.controls) else none

    def probe(self, mean: Array, cov: Array, keys: Any, width: int) -> None:
        """Try the estimator on the first reading of which all has come."""
        came = np.isfinite(self.readings).all(axis=(1, 2))
        y = np.nan_to_num(self.readings[int(came.argmax())])
        rising = np.flatnonzero(np.diff(self.clock) > 0)
        k = int(rising[0]) if len(rising) else 0
        begin = float(self.clock[k])
        end = float(self.clock[k + 1]) if len(rising) else begin + 1.0
        probe_estimator(
            self.estimator, (mean, cov), self.control(k + 1), y, (begin, end), width, keys=keys
        )

    def history(self, belief: Any, output: Manifold, sizes: tuple[int, int]) -> Followed:
        """From the belief at the first time to the last; `sizes` are nx and n."""
        times, index = np.unique(self.clock, return_inverse=True)
        count, runs = len(times), self.readings.shape[1]
        log = Innovations({"y": output}, count, runs, self.keep != "last")
        beliefs, held, fused = [], [], [[] for _ in times]
        means, covs = [], []
        fault = np.zeros(runs, np.uint8)
        for k, (place, t) in enumerate(zip(index.tolist(), self.clock.tolist())):
            u = self.control(k)
            if k and place > index[k - 1]:
                before = float(times[place - 1])
                belief = self.estimator.predict(belief, u, before, t - before)
                held.append(u)
            came = ~np.isnan(self.readings[k])
            if came.any():
                mask = None if came.all() else came
                m = Measurement(np.where(came, self.readings[k], 0.0), u, None, mask)
                answer = self.estimator.update(belief, m.y, m.u, t, m.channels, m.mask)
                belief, innovation = self.answers.checked(answer, _CHANNEL, runs, output.n)
                fault = kept(fault, self.answers.innovation(belief, innovation, mask))
                log.put(place, len(fused[place]), _CHANNEL, innovation, mask, ALL)
                fused[place].append(m)
            if k + 1 < len(index) and index[k + 1] == place:
                continue  # another reading of the same time
            mean, cov = self.answers.moments(belief, runs, *sizes)
            fault = kept(fault, self.answers.asymmetry(cov))
            if self.keep == "moments":
                means.append(np.array(mean))
                covs.append(np.array(cov))
            if self.keep == "beliefs":
                beliefs.append(belief)
        noted: dict[str, Any] = log.traces()
        v, S = (None if noted[name] is None else noted[name][1:] for name in _KEPT)
        forgets = self.keep != "beliefs"
        return Followed(
            beliefs=[belief] if forgets else beliefs,
            controls=[] if forgets else held,
            times=times.tolist(),
            measurements=[] if forgets else fused,
            index=index,
            fault=fault,
            mean=np.stack(means) if means else None,
            cov=np.stack(covs) if covs else None,
            nis=noted["nis"],
            dof=noted["dof"],
            lags=noted["lags"],
            lag_terms=noted["lag_terms"],
            innovation=v,
            innovation_cov=S,
        )
