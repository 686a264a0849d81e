"""A user's own estimator is tried before a run: is it a pure function of what it is given?"""

from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estbench.errors import EstimatorError
from estbench.estimators.beliefs import start
from estbench.estimators.protocol import Estimator
from estbench.inference.answers import Answers
from estbench.models.protocol import Channels
from estbench.shapes import Array, Float, Keys, UInt

STEPS = 3
"""Predictions and updates of one trial."""
_IMPURE = (
    "it draws random numbers of its own (take `keys` in init and derive them from these) or keeps "
    "a state outside of the belief"
)


def probe_estimator(
    estimator: Estimator,
    prior: tuple[Float[Array, "run nx"], Float[Array, "run n n"]],
    u: Float[Array, "run nu"],
    y: Float[Array, "run ny"],
    times: tuple[float, float],
    width: int,
    channels: Channels = None,
    keys: UInt[Keys, " run"] | None = None,
) -> None:
    """Some steps, each twice, and all of them again, also with equal runs.

    Args:
        estimator: any object of the protocol.
        prior: x̂₀ and P₀; the runs may be equal.
        u: a control.
        y: a measurement.
        times: the start and the end of the first step, s.
        width: components of the tangent of y.
        channels: that y consists of.
        keys: a random key per run for estimators whose `init` takes `keys`.

    Raises:
        EstimatorError: a method gives other numbers when it is called again with the same belief,
            changes what it is given, or mixes the runs.
        DimensionError: an answer has the wrong shape.
    """
    answers = Answers(estimator)
    sizes = (*prior[0].shape, prior[1].shape[-1])
    trial = _Trial(estimator, answers, times, channels, keys, sizes, width)
    first = trial.course(prior, u, y)
    if not _same(first, trial.course(prior, u, y)):
        raise EstimatorError(
            f"{answers.name} gives another result when the same steps are taken again from the "
            f"same prior: {_IMPURE}"
        )
    alike = [np.repeat(a[-1:], len(a), axis=0) for a in (*prior, u, y)]
    alone = trial.course((alike[0], alike[1]), alike[2], alike[3])
    for one, several in zip(alone, first):
        if not np.allclose(one[-1], several[-1], rtol=1e-6, atol=1e-12, equal_nan=True):
            raise EstimatorError(
                f"{answers.name} mixes the runs: its result for one of {len(y)} runs depends on "
                "the others; every array has a leading run axis"
            )


class _Trial:
    """Steps of one estimator under watch."""

    def __init__(
        self,
        estimator: Estimator,
        answers: Answers,
        times: tuple[float, float],
        channels: Channels,
        keys: Keys | None,
        sizes: tuple[int, int, int],
        width: int,
    ):
        self._estimator, self._answers, self._channels = estimator, answers, channels
        self._start, self._dt, self._keys = times[0], times[1] - times[0], keys
        self._sizes, self._width = sizes, width

    def course(self, prior: tuple[Array, Array], u: Array, y: Array) -> list[Array]:
        """Means, covariances and NIS after each of some steps."""
        given = [a.copy() for a in prior]
        belief = start(self._estimator, *given, self._keys)
        self._unchanged("init", given, list(prior))
        out = list(self._moments(belief))
        for k in range(STEPS):
            t = self._start + k * self._dt
            belief = self._twice(
                "predict",
                lambda b, u=u, t=t: self._estimator.predict(b, u, t, self._dt),
                belief,
                [u],
            )
            out += self._moments(belief)
            answer = self._twice(
                "update",
                lambda b, u=u, y=y, t=t: self._estimator.update(
                    b, y, u, t + self._dt, self._channels
                ),
                belief,
                [y, u],
            )
            belief = answer[0]
            out += [*self._moments(belief), np.array(answer[1].nis)]
        return out

    def _twice(
        self, method: str, call: Callable[[Any], Any], belief: Any, given: list[Array]
    ) -> Any:
        """The answer of a method, called twice on one belief."""
        held, arguments = _copies(belief), [a.copy() for a in given]
        moments = self._moments(belief)
        answer = call(belief)
        now = [*_arrays(belief)]
        if not (_same(now, held) and _same(self._moments(belief), moments)):
            raise EstimatorError(
                f"{self._answers.name}: {method} changes the belief that it is given; return a new "
                "one, and change copies only"
            )
        self._unchanged(method, given, arguments)
        if not _same(self._numbers(method, answer), self._numbers(method, call(belief))):
            raise EstimatorError(
                f"{self._answers.name}: {method} gives another result when it is called again with "
                f"the same belief: {_IMPURE}"
            )
        return answer

    def _numbers(self, method: str, answer: Any) -> list[NDArray[Any]]:
        """What is compared of an answer."""
        if method == "predict":
            return self._moments(answer)
        channels = tuple(self._channels or ())
        belief, innovation = self._answers.checked(answer, channels, self._sizes[0], self._width)
        return [*self._moments(belief), np.array(innovation.nis)]

    def _moments(self, belief: Any) -> list[NDArray[Any]]:
        return [np.array(a) for a in self._answers.moments(belief, *self._sizes)]

    def _unchanged(self, method: str, now: list[Array], before: list[Array]) -> None:
        """Refuse a method that wrote into its arguments."""
        if not _same(now, before):
            raise EstimatorError(
                f"{self._answers.name}: {method} changes an array that it is given in place; "
                "change copies only"
            )


def _same(a: list[NDArray[Any]], b: list[NDArray[Any]]) -> bool:
    """Whether two lists of arrays agree to the last bit; NaN agrees with NaN."""
    return len(a) == len(b) and all(
        x.shape == y.shape and np.array_equal(x, y, equal_nan=x.dtype.kind in "fc")
        for x, y in zip(a, b)
    )


def _copies(value: Any) -> list[NDArray[Any]]:
    return [a.copy() for a in _arrays(value)]


def _arrays(value: Any) -> Iterator[NDArray[Any]]:
    """The arrays of a belief: of its fields, attributes, entries, to any depth."""
    if isinstance(value, np.ndarray):
        yield value
    elif isinstance(value, dict):
        for part in value.values():
            yield from _arrays(part)
    elif isinstance(value, list | tuple):
        for part in value:
            yield from _arrays(part)
    elif is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            yield from _arrays(getattr(value, field.name))
