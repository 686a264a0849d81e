"""What is recorded of every update: NIS, log-likelihood, lags, and ν and S where asked for."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from estbench.estimators.likelihood import log_likelihood
from estbench.estimators.protocol import Innovation
from estbench.inference.lags import Lags
from estbench.inference.run_subset import RunIndex
from estbench.shapes import Bool, Mask
from estbench.spaces.manifold import Manifold


def readings(spaces: Mapping[str, Manifold]) -> tuple[str, ...]:
    """Name of each component of the measurement: the channel's, with the coordinate's."""
    return tuple(
        channel if space.n == 1 else f"{channel}.{name}"
        for channel, space in spaces.items()
        for name in space.names
    )


class InnovationLog(Protocol):
    """What is told of every update.

    Attributes:
        rows: how many there are.
    """

    rows: int

    def clear(self, k: int, rows: RunIndex) -> None:
        """Some rows are updated anew at the k-th event: what was put of them there is void."""
        ...

    def put(
        self,
        k: int,
        layer: int,
        channels: Sequence[str],
        innovation: Innovation,
        mask: Bool[Mask, "run m"] | None,
        rows: RunIndex,
    ) -> None:
        """Some rows were updated; see `Innovations.put`."""
        ...


class Innovations:
    """The innovations of a batch, noted as the event loop fuses readings.

    A late reading makes the loop update again from its instant on: `clear` says of which runs, and
    what is noted then replaces what was.

    Args:
        spaces: channel -> the manifold of its readings, in the measurement's order.
        count: of instants that are held at once; those before are to be let go (`drop`).
        runs: how many.
        keep: whether to record ν and S too.

    Attributes:
        rows: how many runs.
    """

    def __init__(self, spaces: Mapping[str, Manifold], count: int, runs: int, keep: bool = False):
        stops = np.cumsum([0, *(space.n for space in spaces.values())])
        self._columns = {name: np.arange(a, b) for name, a, b in zip(spaces, stops, stops[1:])}
        self.rows = runs
        self._first = 0  # the instant of the first row
        self._nis, self._dof = np.zeros((count, runs)), np.zeros((count, runs), np.int64)
        self._likelihood, self._gated = np.zeros_like(self._nis), np.zeros_like(self._dof)
        self._lags = Lags(runs, {name: space.n for name, space in spaces.items()})
        shape = count + 1, runs, stops[-1]
        self._kept = (np.full(shape, np.nan), np.full((*shape, shape[-1]), np.nan)) if keep else ()

    def clear(self, k: int, rows: RunIndex) -> None:
        """Forget what some runs had at instant k."""
        row = k - self._first
        self._nis[row, rows], self._dof[row, rows] = 0.0, 0
        self._likelihood[row, rows], self._gated[row, rows] = 0.0, 0
        for kept in self._kept:
            kept[row + 1, rows] = np.nan

    def put(
        self,
        k: int,
        layer: int,
        channels: Sequence[str],
        innovation: Innovation,
        mask: Bool[Mask, "run m"] | None,
        rows: RunIndex,
    ) -> None:
        """Note an update.

        Args:
            k: the instant at which the readings belong.
            layer: of the instant's updates; of two readings of one component NIS and the
                log-likelihood have the sum, ν and S the last.
            channels: that were fused.
            innovation: of some runs.
            mask: of those runs, True where a component arrived; None means everywhere.
            rows: which runs they are.
        """
        row = k - self._first
        self._nis[row, rows] += innovation.nis
        self._dof[row, rows] += innovation.dof
        self._likelihood[row, rows] += log_likelihood(innovation, mask)
        gated = getattr(innovation, "gated", None)
        if gated is not None:
            self._gated[row, rows] += gated
        fused = np.reshape(innovation.dof, (-1, 1)) > 0
        if not fused.all():  # a start gathers readings before it fuses any
            mask = fused if mask is None else mask & fused
        if np.size(innovation.white):  # an estimator may have none, and no ν and S either
            m = np.shape(innovation.white)[-1]
            came = None if mask is None else np.broadcast_to(mask, (len(mask), m))
            if np.min(innovation.dof) < m:
                dof = np.broadcast_to(np.ravel(innovation.dof), len(innovation.white))
                if dof.sum() < (m * len(dof) if came is None else came.sum()):
                    # Not fused, as no return is predicted: such a component is exactly zero.
                    came = mask = (innovation.white != 0) & (True if came is None else came)
            self._lags.put(k, layer, channels, innovation.white, came, rows)
        if self._kept and np.size(getattr(innovation, "residual", ())):
            self._keep(row, channels, innovation, mask, rows)

    def settle(self, first: int) -> None:
        """The instants before `first` are updated no more."""
        self._lags.settle(first)

    def _keep(
        self,
        row: int,
        channels: Sequence[str],
        innovation: Innovation,
        mask: Bool[Mask, "run m"] | None,
        rows: RunIndex,
    ) -> None:
        """Write ν and S where they belong."""
        residual, cov = (kept[row + 1] for kept in self._kept)
        runs = np.arange(self.rows)[rows]
        where = np.concatenate([self._columns[name] for name in channels])
        came = np.broadcast_to(True if mask is None else mask, (len(runs), len(where)))
        vector, block = np.ix_(runs, where), np.ix_(runs, where, where)
        residual[vector] = np.where(came, innovation.residual, residual[vector])
        both = came[:, :, None] & came[:, None, :]
        cov[block] = np.where(both, innovation.cov, cov[block])

    @property
    def settled(self) -> int:
        """All that is said of the instants before it is final, the sums of their lags included."""
        return self._lags.settled

    def traces(self, stop: int | None = None, final: bool = True) -> dict[str, Any]:
        """What `Traces` says of innovations.

        Args:
            stop: the first instant that is left out; None for none.
            final: whether nothing is noted after it; else `stop` is at most `settled`.
        """
        lags, lag_terms = self._lags.sums(final)
        residual, cov = self._kept or (None, None)
        last = self._first + len(self._nis) if stop is None else stop
        rows = slice(last - self._first)
        nis, dof = self._nis[rows], self._dof[rows]
        return {
            "nis": np.where(dof > 0, nis, np.nan),
            "dof": dof,
            "log_likelihood": np.where(dof > 0, self._likelihood[rows], 0.0),
            "gated": self._gated[rows],
            "channel_nis": self._lags.nis(last, self._first),
            "lags": lags,
            "lag_terms": lag_terms,
            "innovation": residual,
            "innovation_cov": cov,
        }

    def drop(self, first: int) -> None:
        """Let the instants before one go; the traces that were given are void."""
        gone, self._first = first - self._first, first
        for kept in (self._nis, self._dof, self._likelihood, self._gated):
            left = len(kept) - gone
            kept[:left], kept[left:] = kept[gone:].copy(), 0
        self._lags.drop(first)
