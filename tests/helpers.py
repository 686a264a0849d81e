"""Models and estimators to parametrize over."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import mujoco
import numpy as np

from estbench.estimators.names import BUILTIN
from estbench.experiment.prepared import Setup
from estbench.experiment.recording import trajectory
from estbench.models.differences import Differences
from estbench.models.function import FunctionModel
from estbench.models.linear import LinearModel
from estbench.randomness import streams
from estbench.robots import mjcf
from estbench.robots.disturbance import Disturbance
from estbench.robots.layout import sensor_name, sensor_space, state_space
from estbench.robots.model import MujocoModel, SensorChannel
from estbench.sensors.channel import Channel
from estbench.sensors.clock import Event
from estbench.sensors.delivery import Delivery
from estbench.sensors.sampling import Sampler
from estbench.sensors.timing import Timing
from estbench.shapes import Array, Ints
from estbench.simulation.sources import Trajectory
from estbench.simulation.truth import Simulator
from estbench.spaces.manifold import Manifold

SAMPLED = {"enkf", "pf"}  # their moments err by 1/sqrt(size)
CONTINUOUS = {"cd_ekf"}  # they need a ContinuousModel
PEERS = {"filterpy_ekf", "filterpy_ukf", "stonesoup_ekf", "stonesoup_ukf"}  # slow, and optional
LEGGED = {"contact_ekf", "contact_inekf", "gtsam_inekf"}  # they need a robot with legs
OTHER = {"imm", "robust_ekf", "adaptive_ekf"}  # they depart from the Kalman filter on purpose
ESTIMATORS = sorted(BUILTIN.keys() - PEERS - LEGGED)
DISCRETE = [name for name in ESTIMATORS if name not in CONTINUOUS]
EXACT = [name for name in DISCRETE if name not in SAMPLED | OTHER]
"""Estimators that on a linear-Gaussian model are the Kalman filter."""

JOINTS = """
<mujoco>
  <option timestep="0.004" integrator="Euler"/>
  <default><geom contype="0" conaffinity="0" mass="0.7"/></default>
  <worldbody>
    <body><joint name="lift" type="slide" axis="0 0.6 0.8" damping="0.5"/>
      <geom type="box" size="0.1 0.2 0.15"/>
      <body pos="0 0 0.3">
        <joint name="swing" type="hinge" axis="1 0 0" pos="0 0 0.2" damping="0.1"/>
        <geom type="capsule" size="0.05 0.2"/>
        <body pos="0.3 0 0"><joint name="wrist" type="ball" damping="0.05"/>
          <geom type="box" size="0.1 0.05 0.2" pos="0.1 0.02 0"/>
        </body>
      </body>
    </body>
    <body pos="0 0 2"><freejoint name="root"/><geom type="box" size="0.2 0.1 0.05"/>
      <site name="imu" pos="0.05 0.02 0"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="lifter" joint="lift" gear="3" ctrlrange="-1 1"/>
    <motor name="swinger" joint="swing"/>
  </actuator>
  <sensor>
    <jointpos name="lift_encoder" joint="lift"/>
    <ballquat name="wrist_quat" joint="wrist"/>
    <framequat name="attitude" objtype="site" objname="imu"/>
    <gyro name="gyro" site="imu"/>
  </sensor>
</mujoco>"""

ACTIVATIONS = """
<mujoco>
  <option timestep="0.005" integrator="{integrator}"/>
  <worldbody>
    <body><joint name="slide" type="slide" axis="1 0 0" damping="1"/>
      <geom type="sphere" size="0.1" mass="1"/>
      <body><joint name="hinge" type="hinge" axis="0 1 0" damping="0.1"/>
        <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.5" mass="0.3"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <general name="lag" joint="slide" dyntype="filter" dynprm="0.2" gainprm="4"/>
    <general name="ramp" joint="hinge" dyntype="integrator" gainprm="0.5"
             biastype="affine" biasprm="0 -0.2 -0.1"/>
    <motor name="direct" joint="hinge" gear="0.2"/>
  </actuator>
  <sensor>
    <actuatorfrc name="lag_force" actuator="lag"/>
    <jointvel name="rate" joint="hinge"/>
  </sensor>
</mujoco>"""

FREE = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body><{joint} name="root"/><geom type="box" size="0.2 0.1 0.05" pos="0.02 0 0.01" mass="1"/>
      <site name="imu" pos="0.05 0.02 0"/>
    </body>
  </worldbody>
  <sensor>
    <framequat name="attitude" objtype="site" objname="imu"/>
    <framepos name="position" objtype="site" objname="imu"/> <gyro name="gyro" site="imu"/>
  </sensor>
</mujoco>"""

CONTACT = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <geom type="plane" size="3 3 0.1"/>
    <body pos="0 0 0.098"><freejoint name="box"/>
      <geom type="box" size="0.1 0.1 0.1" mass="1"/>
      <site name="foot" pos="0 0 -0.1" type="box" size="0.11 0.11 0.02"/>
    </body>
  </worldbody>
  <sensor><touch name="touch" site="foot"/><accelerometer name="accel" site="foot"/></sensor>
</mujoco>"""

SENSORS = """
<mujoco>
  <option timestep="0.005" magnetic="0.2 -0.1 0.5"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1"/>
    <body name="arm" pos="0 0 1">
      <joint name="shoulder" type="hinge" axis="0 1 0" damping="0.1"
        range="-0.2 0.2" limited="true"/>
      <geom name="arm" type="capsule" size="0.04" fromto="0 0 0 0.4 0 0" mass="1"/>
      <site name="tool" pos="0.4 0 0" euler="10 20 30"/>
      <body name="hand" pos="0.5 0 0"><joint name="wrist" type="ball" damping="0.02"/>
        <geom name="hand" type="box" size="0.05 0.04 0.03" pos="0.03 0 0" mass="0.3"/>
        <site name="imu" pos="0.02 0.01 0"/> <site name="down" pos="0 0 -0.06" euler="180 0 0"/>
      </body>
    </body>
  </worldbody>
  <tendon><fixed name="cord"><joint joint="shoulder" coef="0.3"/></fixed></tendon>
  <actuator><motor name="motor" joint="shoulder" gear="2"/></actuator>
  <sensor>
    <jointpos name="jointpos" joint="shoulder"/> <jointvel name="jointvel" joint="shoulder"/>
    <jointactuatorfrc name="jointactfrc" joint="shoulder"/>
    <jointlimitpos name="jointlimitpos" joint="shoulder"/>
    <jointlimitvel name="jointlimitvel" joint="shoulder"/>
    <jointlimitfrc name="jointlimitfrc" joint="shoulder"/>
    <ballquat name="ballquat" joint="wrist"/> <ballangvel name="ballangvel" joint="wrist"/>
    <tendonpos name="tendonpos" tendon="cord"/> <tendonvel name="tendonvel" tendon="cord"/>
    <rangefinder name="rangefinder" site="down"/>
    <distance name="geomdist" geom1="floor" geom2="hand" cutoff="5"/>
    <actuatorpos name="actuatorpos" actuator="motor"/>
    <actuatorvel name="actuatorvel" actuator="motor"/>
    <actuatorfrc name="actuatorfrc" actuator="motor"/>
    <accelerometer name="accelerometer" site="imu"/> <gyro name="gyro" site="imu"/>
    <velocimeter name="velocimeter" site="imu"/> <magnetometer name="magnetometer" site="imu"/>
    <force name="force" site="tool"/> <torque name="torque" site="tool"/>
    <framepos name="framepos" objtype="site" objname="imu"/>
    <framequat name="framequat" objtype="site" objname="imu"/>
    <framexaxis name="framexaxis" objtype="site" objname="imu"/>
    <framezaxis name="framezaxis" objtype="site" objname="imu"/>
    <framelinvel name="framelinvel" objtype="site" objname="imu"/>
    <frameangvel name="frameangvel" objtype="site" objname="imu"/>
    <framelinacc name="framelinacc" objtype="site" objname="imu"/>
    <frameangacc name="frameangacc" objtype="site" objname="imu"/>
    <subtreecom name="subtreecom" body="arm"/> <subtreelinvel name="subtreelinvel" body="arm"/>
    <subtreeangmom name="subtreeangmom" body="arm"/>
    <e_potential name="e_potential"/> <clock name="clock"/>
  </sensor>
</mujoco>"""

ZOO = {
    "joints": JOINTS,
    "activations": ACTIVATIONS.format(integrator="Euler"),
    "implicitfast": ACTIVATIONS.format(integrator="implicitfast"),
    "rk4": JOINTS.replace("Euler", "RK4"),
    "free": FREE.format(joint="freejoint"),
    "ball": FREE.format(joint='joint type="ball"'),
    "contact": CONTACT,
    "sensors": SENSORS,
}


@cache
def zoo_model(name: str) -> mujoco.MjModel:
    return mjcf.compile_model(mujoco.MjSpec.from_string(ZOO[name]))


def all_channels(model: mujoco.MjModel, std: float = 0.1) -> list[SensorChannel]:
    widths = [sensor_space(model, [i]).n for i in range(model.nsensor)]
    return [
        SensorChannel(sensor_name(model, i), i, std**2 * np.eye(m)) for i, m in enumerate(widths)
    ]


def mujoco_model(
    name: str,
    kind: Any = "additive",
    density: Any = 0.0,
    nthread=1,
    differences=None,
    channels=None,
) -> MujocoModel:
    model = zoo_model(name)
    chosen = [c for c in all_channels(model) if channels is None or c.name in channels]
    noise = Disturbance.build(model, state_space(model), kind, density)
    return MujocoModel(model, chosen, noise, differences, nthread)


CENTERED = Differences("centered", 1e-6)


def random_states(model: mujoco.MjModel, runs: int, seed: int = 0, scale: float = 0.3):
    """States about qpos0 `(run, nx)` and controls `(run, nu)`."""
    rng = np.random.default_rng(seed)
    space = state_space(model)
    rest = np.concatenate([model.qpos0, np.zeros(model.nv + model.na)])
    x = space.plus(rest, scale * rng.standard_normal((runs, space.n)))
    return x, scale * rng.standard_normal((runs, model.nu))


def random_cov(rng: np.random.Generator, n: int, runs: int | None = None, scale: float = 1.0):
    a = rng.standard_normal((*((runs,) if runs else ()), n, n))
    return scale * (a @ np.swapaxes(a, -1, -2) / n + 0.1 * np.eye(n))


def linear_model(seed: int, n: int = 3, m: int = 2, nu: int = 1) -> LinearModel:
    """A random stable model with a singular Q and a feedthrough."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
    G = rng.standard_normal((n, max(n - 1, 1)))
    return LinearModel(
        A, rng.standard_normal((m, n)), 0.1 * G @ G.T, random_cov(rng, m),
        rng.standard_normal((n, nu)), rng.standard_normal((m, nu)),
    )  # fmt: skip


def nonlinear_model(n: int = 2, jacobians: bool = True, batched: bool = True) -> FunctionModel:
    """A chain of n/2 pendulums, x = (angles, rates), one torque.

    Measured: range and bearing of the first bob from a station, and the sine of the other angles.
    """
    k = n // 2
    stiff = 0.3 * (np.diag(np.ones(k - 1), 1) + np.diag(np.ones(k - 1), -1))
    stiff -= np.diag(stiff.sum(axis=1))

    def f(x, u, t, dt):
        angle, rate = x[..., :k], x[..., k:]
        push = np.concatenate([u, np.zeros((*u.shape[:-1], k - 1))], axis=-1)
        return np.concatenate(
            [angle + dt * rate, rate + dt * (angle @ stiff - np.sin(angle) - 0.1 * rate + push)],
            axis=-1,
        )

    def f_jacobian(x, u, t, dt):
        F = np.broadcast_to(np.eye(n), (*x.shape[:-1], n, n)).copy()
        F[..., :k, k:] = dt * np.eye(k)
        F[..., k:, :k] = dt * (stiff - np.eye(k) * np.cos(x[..., None, :k]))
        F[..., k:, k:] -= 0.1 * dt * np.eye(k)
        return F

    def offset(x):
        return 2.0 - np.sin(x[..., 0]), 1.5 + np.cos(x[..., 0])

    def h(x, u, t):
        dx, dy = offset(x)
        first = np.stack([np.hypot(dx, dy) + 0.2 * u[..., 0], np.arctan2(dy, dx)], axis=-1)
        return np.concatenate([first, np.sin(x[..., 1:k])], axis=-1)

    def h_jacobian(x, u, t):
        dx, dy = offset(x)
        ddx, ddy = -np.cos(x[..., 0]), -np.sin(x[..., 0])
        r2 = dx**2 + dy**2
        H = np.zeros((*x.shape[:-1], k + 1, n))
        H[..., 0, 0] = (dx * ddx + dy * ddy) / np.sqrt(r2)
        H[..., 1, 0] = (dx * ddy - dy * ddx) / r2
        for i in range(1, k):
            H[..., i + 1, i] = np.cos(x[..., i])
        return H

    return FunctionModel(
        f, h, 0.01 * random_cov(np.random.default_rng(n), n),
        0.05 * random_cov(np.random.default_rng(n + 1), k + 1), n_controls=1, batched=batched,
        f_jacobian=f_jacobian if jacobians else None, h_jacobian=h_jacobian if jacobians else None,
    )  # fmt: skip


class ChannelModel:
    """A model whose measurement comes in channels.

    Args:
        model: any that has one channel.
        components: channel -> the components of the measurement that are its own.
    """

    def __init__(self, model: Any, components: Mapping[str, Sequence[int]]):
        self._model, self._components = model, components
        self.space, self.nu = model.space, model.nu
        self.transition, self.transition_jacobian = model.transition, model.transition_jacobian
        self.process_noise = model.process_noise

    def output(self, channels=None) -> Manifold:
        return Manifold.euclidean(len(self._of(channels)))

    def measurement(self, x, u, t, channels=None):
        return self._model.measurement(x, u, t)[..., self._of(channels)]

    def measurement_jacobian(self, x, u, t, channels=None):
        h, H = self._model.measurement_jacobian(x, u, t)
        return h[..., self._of(channels)], H[..., self._of(channels), :]

    def measurement_noise(self, t, channels=None):
        which = self._of(channels)
        return self._model.measurement_noise(t)[..., which, :][..., which]

    def _of(self, channels) -> list[int]:
        return [i for name in channels or self._components for i in self._components[name]]


def simulated(prepared: Setup, runs: int) -> Trajectory:
    """The truth of the first runs of a scenario."""
    return trajectory(prepared, range(runs))


def sampled(timing: Timing, seed: int, runs: Sequence[int], name: str, last: int) -> Ints:
    """Ticks `(reading, run)` at which each run takes the readings that are due up to `last`."""
    due = timing.due(last)[:, None] + np.zeros(len(runs), np.int64)
    if not timing.jitter:
        return due
    uniform = streams.uniforms(seed, runs, f"sensor:{name}:jitter", len(due), 1)[..., 0]
    return timing.sampling_tick(due, uniform)


def arrived(timing: Timing, taken: Ints, seed: int, runs: Sequence[int], name: str) -> Ints:
    """Ticks `(reading, run)` at which readings arrive that were taken so."""
    normal = streams.normals(seed, runs, f"sensor:{name}:latency", len(taken), 1)[..., 0]
    return timing.arrival_tick(taken, np.arange(len(taken))[:, None], normal)


def at_zero(channel: Channel, seed: int, runs: Sequence[int], count: int) -> Array:
    """Readings `(reading, run, m)` of some runs where the true reading is zero."""
    sampler, zero = Sampler([channel], len(runs)), np.zeros((len(runs), channel.space.nx))
    sampler.start(np.arange(len(runs)), seed, runs, 0)
    due = channel.timing.due_tick(np.arange(count)).tolist()
    return np.array([sampler.at(tick, zero)[0].y for tick in due])


@dataclass(eq=False)
class Fleet:
    """Robots that begin at different times, under controls by their own clocks and runs.

    Attributes:
        prepared: the scenario.
        rows: how many robots.
        beginnings: control period -> the rows that begin there, and their runs.
        timed: whether only rows of one clock go on together.
        runs: the run that each row is in.
    """

    prepared: Setup
    rows: int
    beginnings: Mapping[int, tuple[Sequence[int], Sequence[int]]]
    timed: bool = False
    simulator: Simulator = field(init=False)
    runs: Ints = field(init=False)

    def __post_init__(self) -> None:
        self.simulator = self.prepared.robots(self.rows, timed=self.timed)
        self.runs = np.zeros(self.rows, np.int64)

    @classmethod
    def alone(cls, prepared: Setup, run: int) -> "Fleet":
        """One run by itself."""
        return cls(prepared, 1, {0: ([0], [run])})

    @property
    def elapsed(self) -> Ints:
        """Control periods since each row began."""
        return self.simulator.clocks.elapsed // self.prepared.plant.nstep

    def begin(self, period: int) -> tuple[Ints, Ints] | None:
        """The rows that begin before a control period, and their runs."""
        if period not in self.beginnings:
            return None
        rows, runs = (np.array(each) for each in self.beginnings[period])
        seed, u0 = self.prepared.scenario.simulation.seed, self.prepared.plant.u0
        self.simulator.start(rows, seed, runs.tolist(), np.repeat(u0[None], self.rows, axis=0))
        self.runs[rows] = runs
        return rows, runs

    def period(self) -> Iterator[tuple[Event, Array, list[Delivery]]]:
        """The events of a control period: each with the controls held and what arrives."""
        phase = 0.7 * self.elapsed + self.runs
        u = 0.3 * np.sin(phase[:, None] + np.arange(self.prepared.plant.model.nu))
        for event in self.simulator.clocks.period():
            yield event, u, self.simulator.advance(event, u)
