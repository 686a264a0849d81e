"""What an estimator returns, checked at every step; a mistake is named with the estimator's name.

An answer that could not be recorded (its type or shape) is an error. A number that contradicts
others (an asymmetric P, a NIS that is not νᵀ S⁻¹ ν) is a `Fault` of its run.
"""

from typing import Any

import numpy as np

from estbench.errors import DimensionError, EstimatorError
from estbench.estimators.beliefs import Fault
from estbench.estimators.protocol import Estimator, Innovation
from estbench.shapes import Array, Bool, Faults, Float, Mask, UInt
from estbench.spaces.covariance import asymmetric
from estbench.spaces.linalg import cholesky, pad_absent, solve_lower

_SYMMETRY = 1e-6
"""Of the standard deviations: rounding errors of P - K H P stay below."""
_NIS = 1e-3
"""Relative; the rounding errors of an S of condition 1e12 stay below."""
_PARTS = ("white", "residual", "cov")


def kept(faults: UInt[Faults, " run"], new: UInt[Faults, " run"] | None) -> UInt[Faults, " run"]:
    """The faults so far, and new ones where there was none."""
    return faults if new is None else np.where(faults > 0, faults, new).astype(np.uint8)


class Answers:
    """The checks of one estimator's answers.

    Args:
        estimator: any object of the protocol.

    Attributes:
        name: of its class; of the started estimator where a start waits for it.
        own: whether it belongs to estbench: its NIS is computed from ν and S by tested code, and
            only that of a user's estimator is computed again.
    """

    def __init__(self, estimator: Estimator):
        inner = getattr(estimator, "estimator", estimator)
        self.name = type(inner).__name__
        inner = getattr(inner, "_filter", inner)  # of a smoother, or of a filter over another
        self.own = type(inner).__module__.startswith("estbench.")
        self._estimator = estimator
        self._seen: set[tuple[str, ...]] = set()

    def checked(
        self, answer: Any, channels: tuple[str, ...], runs: int, m: int
    ) -> tuple[Any, Innovation]:
        """What `update` returned, refused where it could not be recorded.

        The first answers for these channels are checked, up to one that fuses: a start only
        gathers. A user's estimator is checked every time.

        Args:
            answer: what `update` returned for `runs` runs of m components.
            channels: that were fused.
            runs: how many.
            m: components of the joint measurement's tangent.

        Raises:
            EstimatorError: it is no pair of a belief and an innovation, or a number is complex or
                masked.
            DimensionError: nis or dof is not `(run,)`, or white or residual `(run, m)`, or cov
                `(run, m, m)`; these three may be empty, and dof and cov the same for all runs; or
                log_likelihood, if it is given, not `(run,)`.
        """
        if self.trusted(channels):
            return answer
        self.pair(answer)
        shapes = {"nis": (runs,), "dof": (runs,), "white": (runs, m), "residual": (runs, m)}
        shapes |= {"cov": (runs, m, m), "log_likelihood": (runs,)}
        for name, expected in shapes.items():
            if getattr(answer[1], name, None) is None:
                continue
            found = np.shape(self._real("update", name, getattr(answer[1], name)))
            none = name not in ("nis", "dof", "log_likelihood") and 0 in found
            shared = name in ("dof", "cov") and found in (expected[1:], (1, *expected[1:]))
            if found != expected and not none and not shared:
                raise DimensionError(
                    f"{self.name}: update returned an Innovation whose {name} has shape {found}; "
                    f"expected {expected}"
                )
        dof = np.asarray(answer[1].dof)
        if not ((dof >= 0) & (dof <= m)).all():
            raise EstimatorError(
                f"{self.name}: update returned an Innovation whose dof is {dof.ravel()[0]}; "
                f"expected the number of components that arrived, 0 to {m}"
            )
        if dof.any():
            self._seen.add(channels)
        return answer

    def trusted(self, channels: tuple[str, ...]) -> bool:
        """Whether answers for these channels need no further check."""
        return self.own and channels in self._seen

    def pair(self, answer: Any) -> tuple[Any, Innovation]:
        """What `update` returned, as a belief and an innovation.

        Raises:
            EstimatorError: it is no such pair.
        """
        pair = isinstance(answer, tuple | list) and len(answer) == 2
        if not pair or any(not hasattr(answer[1], name) for name in ("nis", "dof", "white")):
            parts = answer if pair else [answer]
            raise EstimatorError(
                f"{self.name}: update returned {', '.join(type(part).__name__ for part in parts)}; "
                "return a pair, the belief and an Innovation"
            )
        return answer[0], answer[1]

    def innovation(
        self, belief: Any, innovation: Innovation, mask: Bool[Mask, "run m"] | None
    ) -> UInt[Faults, " run"] | None:
        """`Fault.NIS` where NIS is negative, not finite or not νᵀ S⁻¹ ν = |ν̃|²; None for nowhere.

        A run whose belief is not finite has failed and needs no NIS.
        """
        if self.own:
            return None
        nis = np.asarray(innovation.nis)
        wrong = ~(nis >= 0) | ~np.isfinite(nis) | self._unfit(innovation, mask)
        if not wrong.any():
            return None
        alive = np.isfinite(np.asarray(self._estimator.mean(belief))).all(axis=-1)
        return np.where(wrong & alive, Fault.NIS, Fault.NONE).astype(np.uint8)

    def moments(
        self, belief: Any, runs: int, nx: int, n: int
    ) -> tuple[Float[Array, "run nx"], Float[Array, "run n n"]]:
        """x̂ and P of a belief.

        Raises:
            EstimatorError: a number is complex or masked.
            DimensionError: they are not `(runs, nx)` and `(runs, n, n)`.
        """
        mean, cov = self._estimator.mean(belief), self._estimator.cov(belief)
        if type(mean) is not np.ndarray or mean.dtype != np.float64:
            mean = self._real("mean", "x̂", mean)
        if type(cov) is not np.ndarray or cov.dtype != np.float64:
            cov = self._real("cov", "P", cov)
        if mean.shape != (runs, nx) or cov.shape != (runs, n, n):
            raise DimensionError(
                f"{self.name}: mean has shape {mean.shape} and cov {cov.shape}; "
                f"expected {(runs, nx)} and {(runs, n, n)}"
            )
        return mean, cov

    def reasons(self, belief: Any, runs: int) -> UInt[Faults, " run"] | None:
        """The `Fault` of each run that a belief states; None where it states none.

        Raises:
            EstimatorError: it is no `Fault` of each run.
        """
        given = getattr(belief, "fault", None)
        if given is None:
            return None
        found = np.asarray(given)
        if found.shape != (runs,) or not np.isin(found, list(Fault)).all():
            unknown = next((x for x in found.ravel().tolist() if x not in list(Fault)), found.shape)
            raise EstimatorError(
                f"{self.name}: the fault of its belief is {unknown}; give one value of `Fault` for "
                f"each run, {min(Fault):d} to {max(Fault):d}, 0 for none"
            )
        return found.astype(np.uint8)

    @staticmethod
    def asymmetry(cov: Float[Array, "run n n"]) -> UInt[Faults, " run"] | None:
        """`Fault.ASYMMETRIC` where P differs from Pᵀ beyond rounding; None for nowhere."""
        skew = cov - cov.mT
        if not np.vdot(skew, skew):  # exactly symmetric, as those of estbench
            return None
        wrong = asymmetric(cov, _SYMMETRY)
        if not wrong.any():
            return None
        return np.where(wrong, Fault.ASYMMETRIC, Fault.NONE).astype(np.uint8)

    def _real(self, method: str, name: str, given: Any) -> Array:
        """Numbers that a user's estimator returned, as real ones."""
        values = np.asarray(given)
        masked = isinstance(given, np.ma.MaskedArray)
        if masked or values.dtype.kind not in "biuf":
            kind = "a masked array" if masked else f"{type(given).__name__} of {values.dtype}"
            raise EstimatorError(
                f"{self.name}: {method} returned {kind} for {name}; return real numbers, float64"
            )
        return np.asarray(values, np.float64)

    @staticmethod
    def _unfit(innovation: Innovation, mask: Mask | None) -> Mask:
        """Where NIS is not νᵀ S⁻¹ ν, if ν and S are there and all that arrived was used."""
        nis, dof = np.asarray(innovation.nis), np.asarray(innovation.dof)
        parts = {name: np.asarray(getattr(innovation, name, ())) for name in _PARTS}
        white, residual, S = parts.values()
        wrong = np.zeros(len(nis), bool)
        if not white.size and not residual.size:
            return wrong
        m = white.shape[-1] if white.size else residual.shape[-1]
        present = np.ones((len(nis), m), bool) if mask is None else mask
        if white.size:
            came = np.where(present, white, 0.0)
            wrong |= ~np.isclose(np.vecdot(came, came), nis, rtol=_NIS, atol=1e-9)
        if residual.size and S.size:
            S = pad_absent(np.broadcast_to(S, (len(nis), m, m)), present)
            came = solve_lower(cholesky(S), np.where(present, residual, 0.0)[..., None])[..., 0]
            wrong |= ~np.isclose(np.vecdot(came, came), nis, rtol=_NIS, atol=1e-9)
            wrong |= asymmetric(S, _SYMMETRY)
        return wrong & (dof == present.sum(axis=-1))
