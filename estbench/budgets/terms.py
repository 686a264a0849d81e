"""The terms of the linear recursion along true runs: F, Q, H, R of each step, by sources."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from estbench.bounds.linearization import Linearization
from estbench.bounds.scenario import true_model
from estbench.budgets.fixed import WrongModel
from estbench.budgets.layout import CONSTANT, Layout
from estbench.budgets.recursion import Interval, Reading
from estbench.budgets.sources import sources
from estbench.experiment.prepared import Setup
from estbench.models.protocol import Model
from estbench.sensors.channel import Channel
from estbench.shapes import Array, Float
from estbench.simulation.sources import Trajectory


class Terms:
    """What the recursion needs of each step, linearized at the true states.

    The filter's model may have further states (biases, a seen disturbance); the errors of sensors
    are not part of its truth, for which they are zero, but enter the readings.

    Args:
        setup: the experiment.
        label: of the estimator.
        model: of the filter.
        happened: in some runs.

    Attributes:
        layout: the places of the sources.
        runs: how many.
        n: coordinates of the filter's state.
    """

    def __init__(self, setup: Setup, label: str, model: Model, happened: Trajectory):
        self._setup, self._happened, self._model = setup, happened, model
        self._filter, self._truth = Linearization(model), true_model(setup, {})
        found = sources(setup, label)
        self._wrong = WrongModel.of(setup, label, self._truth, found)
        self.layout = Layout.of(setup, found, self._wrong.rest)
        self.runs, self.n = happened.x.shape[1], model.space.n
        self._channels = {c.name: c for c in setup.channels}
        self._wrong_columns = [
            int(self.layout.columns(i)[0]) for i in self.layout.where("parameter", "draw", "model")
        ]
        self._of_process = self.layout.where("process")

    @cached_property
    def _extra(self) -> Array:
        """The further states of the filter, which are zero in truth."""
        return np.zeros((self.runs, self._model.space.nx - self._setup.space.nx))

    def _state(self, k: int) -> Array:
        return np.concatenate([self._happened.x[k], self._extra], axis=-1)

    def interval(self, k: int) -> Interval:
        """The prediction from the k-th time to the next."""
        instant, u = self._setup.instants[k], self._happened.u[k]
        t, dt = instant.start, instant.end - instant.start
        F, _ = self._filter.transition(self._state(k), self._state(k + 1), u, t, dt)
        layout, x = self.layout, self._happened.x[k]
        Q = np.zeros((self.runs, len(layout.white), self.n, self.n))
        if self._of_process:
            G = self._response(x, u, t, dt)
            at = [layout.white.index(i) for i in self._of_process]
            Q[:, at] = np.einsum("rnk,sk,rmk->rsnm", G, self._of_each_process, G)
        d = None
        if self._wrong.width:
            d = np.zeros((self.runs, self.n, len(layout.owner)))
            n = self._setup.space.n
            d[:, :n, self._wrong_columns] = self._wrong.of_transition(x, u, t, dt)
        return Interval(F, Q, d, *layout.drift(dt))

    def reading(self, k: int, channels: Sequence[str], taken: Sequence[Array | None]) -> Reading:
        """A joint measurement at the k-th time.

        Args:
            k: index of the time.
            channels: in order.
            taken: of each channel the index of the time at which each run's reading was taken,
                where that is not the k-th.
        """
        t, u = self._setup.instants[k - 1].end, self._happened.u[k - 1]
        names = tuple(channels)
        y, H, _ = self._filter.measurement(self._state(k), u, t, names)
        R = self._truth.measurement_noise(t, names)
        m, layout = H.shape[-2], self.layout
        s = np.zeros((self.runs, m, len(layout.owner)))
        each = np.zeros((len(layout.white), m, m))
        C = np.zeros((len(layout.white), m, layout.width))
        row = start = 0
        for name, late in zip(names, taken):
            channel = self._channels[name]
            rows = slice(row, row + channel.space.n)
            clean = y[:, start : start + channel.space.nx]
            clean = np.where(np.isfinite(clean), clean, 0.0)
            for i, source in enumerate(layout.sources):
                if source.target != name or source.group != name:
                    continue
                if source.kind in CONSTANT:
                    error = layout.errors[i]
                    s[:, rows, layout.columns(i)] = error.slope(clean) * error.std
                elif source.kind in ("walk", "drift"):
                    slope = layout.errors[i].slope(clean)
                    C[layout.white.index(i), rows, : slope.shape[-1]] = slope
                elif source.kind == "timing" and late is not None:
                    s[:, rows, layout.columns(i)[0]] = self._delayed(channel, k, late)
                elif i in layout.white:
                    own = _noise(channel, source.kind, R[rows, rows])
                    each[layout.white.index(i), rows, rows] = own
            row, start = rows.stop, start + channel.space.nx
        if self._wrong.width:
            x = self._happened.x[k]
            s[:, :, self._wrong_columns] = self._wrong.of_measurement(x, u, t, names)
        return Reading(np.where(np.isfinite(H), H, 0.0), each, s, C)

    def _delayed(self, channel: Channel, k: int, taken: Array) -> Float[Array, "run m"]:
        """The true reading when it was taken, minus that at the time to which it is fused."""
        x, u = self._happened.x, self._happened.u
        run, at = np.arange(self.runs), np.clip(np.rint(taken), 1, len(u)).astype(int)
        t, names = self._setup.instants[k - 1].end, (channel.name,)
        then = self._truth.measurement(x[at, run], u[at - 1, run], t, names)
        now = self._truth.measurement(x[k], u[k - 1], t, names)
        change = channel.space.minus(then, now)
        return np.where(np.isfinite(change), change, 0.0)

    def _response(self, x: Array, u: Array, t: float, dt: float) -> Float[Array, "run n k"]:
        """Γ of the true disturbance, on the filter's state."""
        if self._setup.seen and self.n > self._setup.space.n:
            gain, root = self._truth.disturbance_gain(x, u, t, dt)
            G = np.concatenate([gain, np.broadcast_to(root, (len(x), *root.shape))], axis=-2)
        else:
            G = self._truth.noise_response(x, u, t, dt)
        out = np.zeros((self.runs, self.n, G.shape[-1]))
        out[:, : G.shape[-2]] = G
        return out

    @cached_property
    def _of_each_process(self) -> Float[Array, "s k"]:
        """Which columns of Γ belong to which source."""
        layout, factor = self.layout, self._setup.disturbance.factor
        if not layout.sources[self._of_process[0]].target:
            return np.ones((1, factor.shape[1]))
        axes = np.flatnonzero(factor.any(axis=1))  # one source each, in this order
        return (factor[axes] != 0.0).astype(np.float64)


def _noise(channel: Channel, kind: str, R: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """The covariance of one kind of white noise."""
    part = channel.imperfections
    if kind == "noise" or part is None:
        return R
    if kind == "outliers":  # (1 - p) R + p s² R, less R
        return part.outlier_probability * (part.outlier_scale**2 - 1.0) * R
    return np.diag(part.quantization**2 / 12.0)
