"""The covariance of the best filter with each of many suites of sensors, all in one pass.

The Kalman filter's recursion along a true motion, with the rows of R^(-1/2) H one after the other:

    s = 1 + h P hᵀ,   P⁺ = P - P hᵀ h P / s

A suite weighs each channel: 0 leaves it out, 1 takes it, 2 halves the noise's standard deviation.
The sum of ½ log s over all rows is the mutual information between the unknowns and the readings
(Gaussian), in nats. It grows with each channel, and the gain of a channel is the smaller the more
others there are, as readings are independent given the unknowns (Krause & Guestrin 2005).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from estbench.shapes import Array, Float
from estbench.spaces.linalg import symmetrize
from estbench.suites.along import Motion, Step

Suite = Mapping[str, float]
"""Channel -> factor on R^(-1/2); a channel that is not named has 0."""
BATCH = 256
"""Suites that are followed at once."""


@dataclass(frozen=True, eq=False)
class Shown:
    """What suites show.

    Attributes:
        mse: mean variance of each coordinate over the times that count, (unit)².
        information: mutual information of unknowns and readings, nats.
    """

    mse: Float[Array, "suite n"]
    information: Float[Array, " suite"]


@dataclass(frozen=True, eq=False)
class Course:
    """The steps of a motion of one run, and the times that count.

    Attributes:
        root: a square root of the covariance at the start.
        steps: F, Γ and R^(-1/2) H.
        counts: whether the end of each step counts.
    """

    root: Float[Array, "n r"]
    steps: Sequence[Step]
    counts: Sequence[bool]

    @classmethod
    def of(cls, motion: Motion, burn_in: float = 0.0) -> "Course":
        """That of a motion; times up to `burn_in` s do not count."""
        return cls(motion.root, list(motion.steps()), (motion.times[1:] > burn_in).tolist())

    def shown(self, suites: Sequence[Suite]) -> Shown:
        """What each suite shows."""
        parts = [self._batch(suites[i : i + BATCH]) for i in range(0, len(suites), BATCH)]
        return Shown(
            np.concatenate([part.mse for part in parts]),
            np.concatenate([part.information for part in parts]),
        )

    def _batch(self, suites: Sequence[Suite]) -> Shown:
        count, n = len(suites), len(self.root)
        channels = {name for step in self.steps for name, *_ in step.seen}
        weight = {c: np.array([float(s.get(c, 0.0)) for s in suites]) for c in channels}
        P = np.broadcast_to(self.root @ self.root.T, (count, n, n)).copy()
        mse, information = np.zeros((count, n)), np.zeros(count)
        for step, counts in zip(self.steps, self.counts):
            F, G = step.F[0], step.G if step.G.ndim == 2 else step.G[0]
            P = symmetrize(F @ P @ F.T + G @ G.T)
            for name, W, mask in step.seen:
                if mask is not None and not mask[0]:
                    continue
                for row in W[0]:
                    h = weight[name][:, None] * row
                    Ph = (P @ h[..., None])[..., 0]
                    s = 1.0 + np.vecdot(h, Ph)
                    P -= Ph[:, :, None] * (Ph / s[:, None])[:, None, :]
                    information += 0.5 * np.log(s)
            if counts:
                mse += np.diagonal(P, axis1=-2, axis2=-1)
        return Shown(np.maximum(mse, 0.0) / max(sum(self.counts), 1), information)
