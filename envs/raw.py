"""A state from the latest readings alone, without a filter, as the reference for a controller."""

from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from estbench.estimators.no_return import returned
from estbench.estimators.protocol import Innovation
from estbench.models.protocol import Channels
from estbench.robots.measurement import needed_stage
from estbench.robots.model import MujocoModel, SensorChannel
from estbench.shapes import Array

ACCELERATION = int(mujoco.mjtStage.mjSTAGE_ACC)


@dataclass(frozen=True, eq=False)
class Held:
    """The last state read, and the age of each position `(row, nv)`, s."""

    mean: Array
    cov: Array
    since: Array


@dataclass(frozen=True)
class RawReadings:
    """The state from the latest readings, with the methods of an estimator.

    A coordinate that sensors measure is taken from them (weighted least squares, H δ = y ⊖ h(x̂),
    about the last state); a velocity that no sensor measures is the change of its position over
    the time between readings; a coordinate that none measures stays where it started. Sensors of
    accelerations and forces are not used, because these are no states.

    Attributes:
        model: a MuJoCo model with its sensors.
    """

    model: MujocoModel

    def init(self, mean: Array, cov: Array) -> Held:
        """Start from mean `(row, nx)`; cov `(row, n, n)` is only kept."""
        return Held(mean, cov, np.zeros((len(mean), self.model.mjmodel.nv)))

    def predict(self, belief: Held, u: Array, t: float, dt: float) -> Held:
        """The state is held; only its age increases."""
        return replace(belief, since=belief.since + dt)

    def update(
        self,
        belief: Held,
        y: Array,
        u: Array,
        t: float,
        channels: Channels = None,
        mask: NDArray[np.bool_] | None = None,
    ) -> tuple[Held, Innovation]:
        """Take the state from the readings y `(row, ny)` that arrived (`mask` `(row, m)`)."""
        model, nv = self.model, self.model.mjmodel.nv
        known = {c.name: c for c in model.channels}
        names = list(known) if channels is None else list(channels)
        useful = np.concatenate(
            [np.full(model.output([name]).n, self._of_state(known[name])) for name in names]
        )
        predicted, H = model.measurement_jacobian(belief.mean, u, t, channels)
        residual = model.output(channels).minus(y, predicted)
        mask = returned(residual, mask)
        residual = np.where(np.isneginf(residual), 0.0, residual)
        R = model.measurement_noise(t, channels)
        used = useful if mask is None else useful & mask
        weight = used / np.sqrt(np.diagonal(R, axis1=-2, axis2=-1))
        Hw = np.nan_to_num(H * weight[..., None])
        delta = np.linalg.pinv(Hw, rcond=1e-6) @ np.nan_to_num(residual * weight)[..., None]
        delta = delta[..., 0]
        seen = np.abs(Hw).max(axis=1) > 1e-6 * np.abs(Hw).max(axis=(1, 2))[:, None]
        position, velocity = slice(0, nv), slice(nv, 2 * nv)
        mean = model.space.plus(belief.mean, delta)
        rate = delta[:, position] / np.maximum(belief.since, 1e-12)
        differenced = seen[:, position] & ~seen[:, velocity] & (belief.since > 0)
        start = model.mjmodel.nq
        mean[:, start : start + nv] = np.where(differenced, rate, mean[:, start : start + nv])
        since = np.where(seen[:, position], 0.0, belief.since)
        count = np.broadcast_to(used, residual.shape).sum(axis=-1)
        zero = np.zeros(len(y))
        innovation = Innovation(np.where(used, residual, 0.0), R, 0.0 * residual, zero, count)
        return replace(belief, mean=mean, since=since), innovation

    def mean(self, belief: Held) -> Array:
        """The state `(row, nx)`."""
        return belief.mean

    def cov(self, belief: Held) -> Array:
        """The initial covariance `(row, n, n)`, because the error is not estimated."""
        return belief.cov

    def _of_state(self, channel: SensorChannel) -> bool:
        """Whether a channel reads positions and velocities only."""
        model, measurand = self.model.mjmodel, channel.measurand
        sensors = (channel.index,) if measurand is None else measurand.sensors
        return needed_stage(model, sensors) < ACCELERATION
