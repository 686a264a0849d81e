"""GTSAM's contact-aided invariant EKF (Dellaert et al., github.com/borglab/gtsam), in `peers`."""

import importlib
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from estbench.errors import EstimatorError, MissingExtraError
from estbench.estimators.contact_aided import ContactBelief
from estbench.estimators.contact_ekf import ContactEKF
from estbench.estimators.foot_readings import joint_step
from estbench.estimators.protocol import Innovation
from estbench.estimators.update import mark_failed
from estbench.models.protocol import Channels
from estbench.shapes import Array, Bool, Float, Mask
from estbench.spaces import rotation
from estbench.spaces.linalg import identity, symmetrize

_ORDER = np.r_[0:3, 6:9, 3:6]
"""Of GTSAM's base (φ, p, v) in ours (φ, v, p)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class GtsamBelief(ContactBelief):
    """What GTSAM's filters say, in the coordinates of `ContactEKF`, and these filters.

    Attributes:
        filters: one for each run; empty before the first reading.
        count: calls of predict and update that led here.
        latest: the count of what the filters hold now, shared by all beliefs.
        dt: of the last prediction, s.
    """

    filters: tuple[Any, ...] = ()
    count: int = 0
    latest: tuple[list[int], ...] = ()
    dt: float = 0.0


@dataclass(frozen=True)
class GtsamInEKF(ContactEKF):
    """GTSAM's `LeggedInvariantEKF`, fed with the same IMU readings, feet and contacts.

    It starts from our belief after the first reading. The biases are not estimated, and the noise
    of a measured foot is one for all times: the mean over the feet of that at the start. The
    process noise of the base that the IMU does not feel is added to that of the accelerometer. Feet
    do not roll; one that slips or has just come down is put down anew, as in `ContactAided`. Its
    filters change in place and cannot be copied, so readings must not come late, and environments,
    whose rows begin anew, refuse it. The innovation is that of `ContactEKF` at the same prior.

    Cost per step: that of `contact_inekf`, run by run. Choose it to check either library.

    Attributes:
        model, threshold, foot_noise, kinematic_noise, joint_acceleration, slip_gate, settle: as in
            `ContactAided`.
        gyro_bias, gyro_walk, accelerometer_bias, accelerometer_walk: zero.

    Raises:
        EstimatorError: a bias is to be estimated, or the IMU's readings come late.
        MissingExtraError: GTSAM is not installed.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("gyro_bias", "gyro_walk", "accelerometer_bias", "accelerometer_walk"):
            if getattr(self, name):
                raise EstimatorError(
                    f"GtsamInEKF: {name} is {getattr(self, name)!r}; GTSAM's filter estimates no "
                    "bias, so leave it out or use contact_inekf"
                )
        library()

    def init(self, mean: Float[Array, "run nx"], cov: Float[Array, "run n n"]) -> GtsamBelief:
        """As `ContactEKF`; GTSAM's filters are made with the first reading."""
        start = super().init(mean, cov)
        return GtsamBelief(**{**vars(start), "latest": ([0],)})

    def predict(
        self, belief: GtsamBelief, u: Float[Array, "run nu"], t: float, dt: float
    ) -> GtsamBelief:
        """`predict` of GTSAM in each run."""
        if not belief.filters:
            return replace(cast(GtsamBelief, super().predict(belief, u, t, dt)), dt=dt)
        self._check(belief)
        for one, reading in zip(belief.filters, belief.imu):
            one.predict(reading[:3], reading[3:], dt)
        joints, joint_cov = joint_step(belief.joints, belief.joint_cov, self.joint_acceleration, dt)
        return replace(
            self._taken(belief), joints=joints, joint_cov=joint_cov, age=belief.age + dt, dt=dt
        )

    def update(
        self,
        belief: GtsamBelief,
        y: Float[Array, "run ny"],
        u: Float[Array, "run nu"],
        t: float,
        channels: Channels = None,
        mask: Bool[Mask, "run m"] | None = None,
    ) -> tuple[GtsamBelief, Innovation]:
        """`processContacts` of GTSAM in each run, with the feet that touch."""
        post, innovation = super().update(belief, y, u, t, channels, mask)
        ours = cast(GtsamBelief, post)
        if not belief.filters:
            made = replace(ours, filters=self._made(ours, u, t))
            return made, innovation
        self._check(belief)
        read = self._readings.sort(belief.imu, belief.joints[:, 0], y, channels, mask)
        touching = self._readings.touching(belief.standing, y, channels, mask) & read.legs
        s, *_ = self._legs.feet(read.joints)
        for i, one in enumerate(belief.filters):
            contacts = []
            for foot in np.flatnonzero(touching[i]).tolist():
                contact = library().ContactMeasurement()
                contact.foot, contact.bodyPoint = foot, s[i, foot]
                contact.touchdown = not ours.measured[i, foot]
                contacts.append(contact)
            one.processContacts(contacts)
        return self._taken(replace(ours, count=belief.count)), innovation

    def _check(self, belief: GtsamBelief) -> None:
        """Refuse a belief of the past: the filters have gone on."""
        if belief.latest[0][0] != belief.count:
            raise EstimatorError(
                "GtsamInEKF: GTSAM's filter cannot go back to an earlier belief; use readings "
                'without latency, or delays = "naive"'
            )

    def _made(self, belief: GtsamBelief, u: Array, t: float) -> tuple[Any, ...]:
        """GTSAM's filters from our belief."""
        gtsam, feet, dt = library(), len(self._legs.touches), belief.dt
        params = gtsam.LeggedEstimatorParams()
        size = float(np.linalg.norm(self._legs.gravity))
        imu = gtsam.PreintegrationParams.MakeSharedU(size)
        Q = self.model.process_noise(self.mean(belief), u, t, dt)
        unfelt = self._base.noise(belief.mean, belief.imu, Q)[:, 3:6, 3:6].mean(axis=0) / dt
        R = self._readings.imu_cov(t)
        imu.setGyroscopeCovariance(R[:3, :3] * dt)
        imu.setAccelerometerCovariance(R[3:, 3:] * dt + unfelt)
        imu.setIntegrationCovariance(np.zeros((3, 3)))
        params.preintegrationParams = imu
        params.imuBias = gtsam.imuBias.ConstantBias()
        params.body_P_imu = gtsam.Pose3()
        params.footholdProcessSigma = self.foot_noise
        params.useFullContactInitialization = False  # else it waits until all feet stand
        params.useRobustContactNoise = False
        _, J, _ = self._legs.feet(belief.joints[:, 0])
        noise = (J * self._readings.encoder_cov(t)) @ J.mT
        params.contactCovariance = noise.mean(axis=(0, 1)) + self.kinematic_noise**2 * identity(3)
        names = list(self._legs.touches)
        T = _tangent(belief.mean, feet)
        P = T.mT @ belief.cov[:, :-6, :-6] @ T
        return tuple(
            gtsam.LeggedInvariantEKF(
                gtsam.NavState(gtsam.Rot3(rotation.matrix(m[:4])), m[7:10], m[4:7]),
                m[10:-6].reshape(feet, 3).T, symmetrize(cov), params, names,
            )
            for m, cov in zip(belief.mean, P)
        )  # fmt: skip

    def _taken(self, belief: GtsamBelief) -> GtsamBelief:
        """The belief with what GTSAM's filters say now."""
        feet = len(self._legs.touches)
        mean, cov = belief.mean.copy(), np.zeros_like(belief.cov)
        for i, one in enumerate(belief.filters):
            found = one.estimate()
            mean[i, :4] = rotation.from_matrix(found.rotation().matrix())
            parts = [found.x(k) for k in (1, 0, *range(2, 2 + feet))]
            mean[i, 4:-6] = np.concatenate(parts)
            cov[i, :-6, :-6] = one.covariance()
        T = _tangent(mean, feet)
        cov[:, :-6, :-6] = T @ cov[:, :-6, :-6] @ T.mT
        belief.latest[0][0] = belief.count + 1
        out = replace(belief, mean=mean, cov=symmetrize(cov), count=belief.count + 1)
        return cast(GtsamBelief, mark_failed(out))


def _tangent(m: Float[Array, "run k"], feet: int) -> Float[Array, "run e e"]:
    """GTSAM's (φ, Rᵀ δp, Rᵀ δv, Rᵀ δd) -> our (φ, δv, δp, δd)."""
    size = 9 + 3 * feet
    T = np.zeros((len(m), size, size))
    R = rotation.matrix(m[:, :4])
    order = np.r_[_ORDER, 9:size].reshape(-1, 3)
    for k, ours in enumerate(order):
        T[:, ours[0] : ours[0] + 3, 3 * k : 3 * k + 3] = R if k else identity(3)
    return T


def library() -> Any:
    """The module `gtsam`, with `LeggedInvariantEKF` (4.3 or later).

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        module = importlib.import_module("gtsam")
    except ImportError:
        raise MissingExtraError("gtsam>=4.3", "peers") from None
    if not hasattr(module, "LeggedInvariantEKF"):
        raise MissingExtraError("gtsam>=4.3", "peers")
    return module
