"""The history of a filter for a smoother, which keeps one window of it."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from estbench.errors import DimensionError
from estbench.estimators.protocol import FilterHistory, Smoother, windows
from estbench.inference.traces import Recorder


class LookingBack:
    """Replaces the filtered beliefs that were recorded by the smoothed ones.

    A smoother with a `window` is asked for each window as soon as no late reading can change it,
    and what it has looked at is forgotten; any other is asked once, for the whole run.

    Args:
        smoother: the estimator.
        start: its belief at the start.
        ends: times of the events, s.
        recorder: of the filtered beliefs.

    Attributes:
        history: to be filled in.
    """

    def __init__(self, smoother: Smoother, start: Any, ends: Sequence[float], recorder: Recorder):
        self._smoother, self._recorder = smoother, recorder
        count = len(ends)
        self.history = FilterHistory(
            [start] * (count + 1), [np.empty(0)] * count, [0.0, *ends], [[]] * (count + 1)
        )
        length = getattr(smoother, "window", None)
        self._ahead = windows(self.history.times, length if count else None)
        self._next = next(self._ahead, None)

    def settle(self, first: int) -> None:
        """Smooth the windows that are settled.

        Args:
            first: number of the first event that may be updated again, so that beliefs up to this
                number are final.

        Raises:
            DimensionError: the smoother returned another count of beliefs than times.
        """
        while self._next is not None and self._next.stop <= first + 1:
            where = self._next
            self._next = next(self._ahead, None)
            smoothed = self._smoother.smooth(self.history.part(where))
            if len(smoothed) != where.stop - where.start:
                raise DimensionError(
                    f"{type(self._smoother).__name__}: smooth returned {len(smoothed)} beliefs; "
                    f"expected {where.stop - where.start}, one per time and one for the start"
                )
            final = self._next is None
            recorder = self._recorder
            for k, belief in enumerate(smoothed if final else smoothed[:-1], where.start):
                recorder.add(k, recorder.truth[k] if recorder.judged else None, belief)
            self.history.forget(slice(where.start, where.stop - 1))
