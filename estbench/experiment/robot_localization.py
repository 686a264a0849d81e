"""The Q, R and P₀ of an estimator as the YAML that robot_localization's filters read.

Its state is (x, y, z, roll, pitch, yaw, their rates, linear accelerations), its prediction adds
Q dt, so `process_noise_covariance` is a spectral density in (unit)²/s, as estbench's Q_s. R has no
parameter there: each message carries its covariance, which the comments give.

Source: T. Moore and D. Stouch, "A Generalized Extended Kalman Filter Implementation for the Robot
Operating System", 2014; its parameters as in the package's `ekf.yaml`.
"""

from collections.abc import Sequence

import numpy as np

from estbench.errors import ScenarioError, did_you_mean
from estbench.experiment.prepared import Setup
from estbench.robots import layout
from estbench.shapes import Array, Float

STATE = (
    "x", "y", "z", "roll", "pitch", "yaw", "vx", "vy", "vz", "vroll", "vpitch", "vyaw",
    "ax", "ay", "az",
)  # fmt: skip
ACCELERATION = 0.01
"""(m/s²)²/s; the package's default: a robot here has no acceleration in its state."""
MESSAGES = {
    "framepos": "pose.covariance (x, y, z)",
    "framequat": "pose.covariance (roll, pitch, yaw) or orientation_covariance",
    "velocimeter": "twist.covariance (x, y, z)",
    "framelinvel": "twist.covariance (x, y, z)",
    "gyro": "angular_velocity_covariance",
    "accelerometer": "linear_acceleration_covariance",
}


def parameters(setup: Setup, label: str) -> str:
    """The YAML of an estimator.

    Linear velocities are along the world's axes here and along the body's there: at the nominal
    pose of a robot that stands level and looks along x they are the same.

    Args:
        setup: the experiment.
        label: of the estimator.

    Raises:
        ScenarioError: no such estimator, or the robot has no free joint.
    """
    if label not in setup.believed:
        hint = did_you_mean(label, setup.believed) or f"; use {', '.join(setup.believed)}"
        raise ScenarioError(f"no estimator '{label}' in the scenario{hint}")
    model = setup.plant.model
    free = np.flatnonzero(model.jnt_type == layout.FREE)
    if not free.size:
        raise ScenarioError(
            f"'{setup.scenario.name}' has no free joint; robot_localization estimates the pose of "
            "a floating base"
        )
    first = int(model.jnt_dofadr[free[0]])
    at = np.r_[first : first + 6, model.nv + first : model.nv + first + 6]
    mean, cov = setup.prior(label)
    period = setup.plant.period
    filters = setup.model(believed=setup.believed[label])
    noise = filters.process_noise(mean[None], setup.plant.u0[None], 0.0, period)
    Q, P = np.zeros((15, 15)), np.eye(15) * 1e-9
    Q[:12, :12] = np.asarray(noise).reshape(-1, *np.shape(noise)[-2:])[0][np.ix_(at, at)] / period
    Q[12:, 12:] = ACCELERATION * np.eye(3)
    P[:12, :12] = cov[np.ix_(at, at)]
    lines = [
        f"# {label} on {setup.scenario.name}, written by estbench.",
        f"# State: {', '.join(STATE)}.",
        "ekf_filter_node:",
        "  ros__parameters:",
        f"    frequency: {_number(1.0 / period)}",
        "    two_d_mode: false",
        "    # (unit)^2/s; that of the accelerations is the default, for they are no state here.",
        *_matrix("process_noise_covariance", Q),
        *_matrix("initial_estimate_covariance", P),
        *_readings(setup, label),
    ]
    return "\n".join(lines) + "\n"


def _matrix(name: str, values: Float[Array, "n n"]) -> list[str]:
    """A flat list in row-major order, one row of the matrix per line."""
    rows = [", ".join(_number(x) for x in row) for row in values.tolist()]
    return [f"    {name}: [", *(f"      {row}," for row in rows[:-1]), f"      {rows[-1]}]"]


def _number(x: float) -> str:
    """A float with a point, which ROS 2 needs in a list of doubles."""
    text = f"{x:.6g}" if abs(x) > 1e-15 else "0.0"
    mantissa, e, exponent = text.partition("e")
    return f"{mantissa}{'' if '.' in mantissa else '.0'}{e}{exponent}"


def _readings(setup: Setup, label: str) -> list[str]:
    """R of the channels that a message of robot_localization may carry."""
    model = setup.plant.model
    believed = setup.model(believed=setup.believed[label])
    lines = ["    # R belongs to the messages of the sensors:"]
    for channel in setup.channels:
        sensors: Sequence[int] = tuple(channel.measurand.sensors)
        kind = layout.sensor_type(model, sensors[0]) if len(sensors) == 1 else ""
        if kind in MESSAGES:
            R = np.asarray(believed.measurement_noise(0.0, (channel.name,)))
            flat = ", ".join(_number(x) for x in R.reshape(-1, *R.shape[-2:])[0].ravel().tolist())
            lines.append(f"    # {channel.name}: {MESSAGES[kind]}: [{flat}]")
    return lines if len(lines) > 1 else []
