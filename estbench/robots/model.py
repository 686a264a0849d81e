"""A MuJoCo model as a state-space model: steps, flow, sensors and Jacobians, batched over runs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from estbench.errors import DimensionError, ScenarioError, did_you_mean
from estbench.models.differences import Differences
from estbench.models.legged import Legs
from estbench.models.protocol import Channels
from estbench.robots import backend, given, layout, legs, level_ground
from estbench.robots.controls import ControlRange
from estbench.robots.disturbance import Disturbance
from estbench.robots.ignorable import ignorable
from estbench.robots.intervals import equal_steps, whole_steps
from estbench.robots.level_ground import LevelGround
from estbench.robots.measurement import Measurand, Plan
from estbench.shapes import Array, Float
from estbench.spaces.linalg import added_first, rescaled
from estbench.spaces.manifold import Manifold

Scale = Callable[[float], float | Array]
_REMEMBERED = 10_000
"""Lengths of intervals whose steps are remembered."""


@dataclass(frozen=True, eq=False)
class SensorChannel:
    """One channel as the filter believes it.

    Attributes:
        name: the channel's name.
        index: the MuJoCo sensor; any number where `measurand` is given.
        cov: R `(m, m)` in the tangent of the reading.
        scale: over time, a factor on the noise's std (one, or one per axis) or R itself `(m, m)`;
            None for a constant.
        measurand: what it reads, where that is not one sensor.
    """

    name: str
    index: int
    cov: Float[Array, "m m"]
    scale: Scale | None = None
    measurand: Measurand | None = None


@dataclass(frozen=True, eq=False)
class _Selection:
    """A set of channels: the plan to read them, and R."""

    plan: Plan
    R: Array
    scales: tuple[tuple[slice, Scale], ...]


class MujocoModel:
    """x⁺ = `mj_step`ᵏ(x, u) ⊞ w, y = sensordata(x, u) ⊞ v.

    A transition over dt is dt/timestep physics steps. A measurement computes the forward stages
    that its channels need, no more. Jacobians are differences of complete steps in the tangent
    space, so every integrator, actuator and sensor type works. It is a `ContinuousModel` too.
    u are the controls, or all inputs of the robot and the number of its model (see `given`).

    Args:
        model: compiled by `mjcf.compile_model` (no warm start, no automatic reset, no clamping).
        channels: the sensors in use.
        disturbance: process noise.
        differences: scheme and step of the Jacobians.
        nthread: number of threads of the backend; see `backend.create`.
        u0: nominal control, about which a `KF` linearizes; default zeros.
        engine: the backend; default one of the model.
        split: whether dt may be any length: it is divided into equal physics steps, each at most as
            long as the timestep.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        channels: Sequence[SensorChannel],
        disturbance: Disturbance,
        differences: Differences | None = None,
        nthread: int | None = 1,
        u0: Float[Array, " nu"] | None = None,
        engine: backend.Backend | None = None,
        split: bool = False,
    ):
        self.mjmodel = model
        self.u0 = np.zeros(model.nu) if u0 is None else u0
        self.channels = tuple(channels)
        self.disturbance = disturbance
        self.differences = differences or Differences()
        self._space = layout.state_space(model)
        self._rates = Manifold.euclidean(self._space.n)
        self._backend = engine or backend.create(model, nthread)
        self._range, self._inputs = ControlRange.of(model), given.size(model)
        self._selections: dict[tuple[str, ...] | None, _Selection] = {}
        self._ignorable = () if engine else tuple(ignorable(model).tolist())
        self._steps: dict[float, int] = {}
        self._split, self._substeps = split, dict[float, float | None]()

    @property
    def space(self) -> Manifold:
        """The manifold of (qpos, qvel, act)."""
        return self._space

    @property
    def nu(self) -> int:
        """Number of controls."""
        return self.mjmodel.nu

    def output(self, channels: Channels = None) -> Manifold:
        """The manifold of the channels' readings."""
        return self._select(channels).plan.space

    def transition(
        self, x: Float[Array, "*lead nx"], u: Float[Array, "... nu"], t: float, dt: float
    ) -> Float[Array, "*lead nx"]:
        """The state after dt/timestep physics steps; NaN where MuJoCo cannot compute it."""
        return self._backend.step(x, self._clamp(u), t, self.steps(dt), None, self.substep(dt))

    def transition_jacobian(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float, dt: float
    ) -> tuple[Float[Array, "run nx"], Float[Array, "run n n"]]:
        """f(x) and Φ by differences of complete transitions.

        The columns of `ignorable` coordinates are those of the identity.
        """
        own = u.shape[-1] == self.nu  # and no other model, nor forces from outside
        return self.differences.jacobian(
            lambda points: self.transition(points, u, t, dt), self._space, self._space, x,
            units=self._ignorable if own else (),
        )  # fmt: skip

    def process_noise(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float, dt: float
    ) -> Float[Array, "... n n"]:
        """Q of the disturbance over dt."""
        if self.disturbance.kind != "additive":
            u = self._clamp(u)
        return self.disturbance.covariance(
            self._backend, self._space, x, u, t, dt, self.steps(dt), self.substep(dt)
        )

    def noise_response(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float, dt: float
    ) -> Float[Array, "... n rank"]:
        """Γ with Q = Γ Γᵀ: the response over dt to a unit of each white noise."""
        noise = self.disturbance
        if noise.kind == "additive":
            return noise.root(t) * np.sqrt(dt)
        if not noise.rank:
            return np.zeros((self._space.n, 0))
        return noise.response(
            self._backend, self._space, x, self._clamp(u), t, dt, self.steps(dt), self.substep(dt)
        ).mT

    def flow(
        self, x: Float[Array, "*lead nx"], u: Float[Array, "... nu"], t: float
    ) -> Float[Array, "*lead n"]:
        """ẋ = (q̇, q̈, ȧ) of the forward dynamics, without the corrections of the integrator."""
        return self._backend.flow(x, self._clamp(u), t)

    def flow_jacobian(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float
    ) -> tuple[Float[Array, "run n"], Float[Array, "run n n"]]:
        """ẋ and ∂ẋ(x ⊞ δ)/∂δ by differences."""
        return self.differences.jacobian(
            lambda points: self.flow(points, u, t), self._space, self._rates, x
        )

    def spectral_density(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float
    ) -> Float[Array, "... n n"]:
        """Q_s of the disturbance as noise on ẋ."""
        return self.disturbance.intensity(self._backend, self._space, x, self._clamp(u), t)

    def measurement(
        self,
        x: Float[Array, "*lead nx"],
        u: Float[Array, "... nu"],
        t: float,
        channels: Channels = None,
    ) -> Float[Array, "*lead ny"]:
        """The readings at x under the control u, without disturbance or noise.

        A component without a return is +inf.
        """
        return self._select(channels).plan.read(self._backend, x, self._clamp(u), t)

    def measurement_jacobian(
        self,
        x: Float[Array, "run nx"],
        u: Float[Array, "run nu"],
        t: float,
        channels: Channels = None,
    ) -> tuple[Float[Array, "run ny"], Float[Array, "run m n"]]:
        """h(x) and H, by differences unless every reading is a component of the state."""
        plan = self._select(channels).plan
        if plan.known is not None:
            return plan.read(self._backend, x, u, t), plan.known[1][None].repeat(len(x), axis=0)
        return self.differences.jacobian(
            lambda points: self.measurement(points, u, t, channels),
            self._space, plan.space, x, plan.reach,
        )  # fmt: skip

    @property
    def disturbances(self) -> Manifold:
        """The forces or controls that are disturbed."""
        if self.disturbance.kind == "actuator":
            names, units = layout.control_names(self.mjmodel), ("1",) * self.nu
        else:
            nv = self.mjmodel.nv
            names = self._space.names[nv : 2 * nv]
            units = tuple("N" if u == "m/s" else "N m" for u in self._space.units[nv : 2 * nv])
        chosen = self.disturbance.places.tolist()
        return Manifold(
            tuple(f"disturbance.{names[i]}" for i in chosen), tuple(units[i] for i in chosen)
        )

    def sees_disturbance(self, channels: Channels = None) -> bool:
        """Whether a channel reads accelerations or forces, or is a function of the control."""
        plan = self._select(channels).plan
        driven = plan.timed and self.disturbance.kind == "actuator"
        return driven or plan.stage >= int(mujoco.mjtStage.mjSTAGE_ACC)

    def disturbance_gain(
        self, x: Float[Array, "run nx"], u: Float[Array, "run nu"], t: float, dt: float
    ) -> tuple[Float[Array, "run n rank"], Float[Array, "k rank"]]:
        """Γ, the change of the end state, and D, the disturbance itself, for unit noises."""
        noise = self.disturbance
        response = noise.response(
            self._backend, self._space, x, self._clamp(u), t, dt, self.steps(dt), self.substep(dt)
        )
        return response.mT, noise.held(t, dt)[noise.places]

    def disturbed_measurement(
        self,
        x: Float[Array, "*lead nx"],
        d: Float[Array, "*lead k"],
        u: Float[Array, "... nu"],
        t: float,
        channels: Channels = None,
    ) -> Float[Array, "*lead ny"]:
        """The readings under the disturbance d of the `disturbances`, without noise."""
        plan, noise, u = self._select(channels).plan, self.disturbance, self._clamp(u)
        whole = np.zeros((*d.shape[:-1], len(noise.density)))
        whole[..., noise.places] = d
        if noise.kind == "force":
            return plan.read(self._backend, x, u, t, whole)
        push = added_first(u if u.ndim == x.ndim else u[:, None], whole)
        return plan.read(self._backend, x, push, t)

    def measurement_noise(self, t: float, channels: Channels = None) -> Float[Array, "... m m"]:
        """R, block-diagonal over the channels."""
        chosen = self._select(channels)
        if not chosen.scales:
            return chosen.R
        R = chosen.R.copy()
        for block, scale in chosen.scales:
            R[block, block] = rescaled(R[block, block], scale(t))
        return R

    @cached_property
    def legs(self) -> Legs:
        """See `models.legged.LeggedModel`.

        Raises:
            ScenarioError: the robot has no legs that a filter could use; see `robots.legs.find`.
        """
        sensors = {}
        for channel in self.channels:
            source = channel.measurand or Measurand.of_sensors(self.mjmodel, channel.index)
            if len(source.sensors) == 1 and source.axes is None:
                sensors[channel.name] = source.sensors[0]
        return legs.find(self.mjmodel, sensors, [c.name for c in self.channels], self._backend)

    @cached_property
    def symmetries(self) -> LevelGround:
        """See `models.symmetric.SymmetricModel`.

        Raises:
            ScenarioError: the robot has no floating base; see `robots.level_ground.find`.
        """
        return level_ground.find(self.mjmodel)

    def steps(self, dt: float) -> int:
        """Number of physics steps in dt.

        Raises:
            ScenarioError: dt is not a positive multiple of the timestep.
        """
        if dt not in self._steps:
            timestep = float(self.mjmodel.opt.timestep)
            if self._split and dt > 0:
                if len(self._steps) >= _REMEMBERED:  # irregular intervals are all different
                    self._steps.clear()
                    self._substeps.clear()
                self._steps[dt], self._substeps[dt] = equal_steps(dt, timestep)
            else:
                self._steps[dt] = whole_steps(dt, timestep, "dt")
        return self._steps[dt]

    def substep(self, dt: float) -> float | None:
        """Length of the physics steps in dt, s; None for the timestep of the robot."""
        return self._substeps.get(dt) if self._split else None

    def follow(self, number: int, model: mujoco.MjModel | None) -> None:
        """See `Backend.follow`."""
        self._backend.follow(number, model)

    def _clamp(self, u: Array) -> Array:
        if u.shape[-1] == self.nu:
            return self._range.clamp(u)
        if u.shape[-1] != self._inputs + 1:
            raise DimensionError(f"u has {u.shape[-1]} controls; expected {self.nu}")
        return u  # clamped by whoever gives all inputs: the range may be of another model

    def _select(self, names: Channels) -> _Selection:
        key = None if names is None else tuple(names)
        if key not in self._selections:
            self._selections[key] = self._build_selection(key)
        return self._selections[key]

    def _build_selection(self, names: tuple[str, ...] | None) -> _Selection:
        known = {c.name: c for c in self.channels}
        for name in names or ():
            if name not in known:
                raise ScenarioError(f"no channel '{name}'{did_you_mean(name, known)}")
        chosen = self.channels if names is None else [known[name] for name in names]
        sources = [c.measurand or Measurand.of_sensors(self.mjmodel, c.index) for c in chosen]
        plan = Plan(self.mjmodel, sources)
        R = np.zeros((plan.space.n, plan.space.n))
        scales = []
        start = 0
        for channel, source in zip(chosen, sources):
            width = source.space.n
            if channel.cov.shape != (width, width):
                raise DimensionError(
                    f"channel '{channel.name}': R has shape {channel.cov.shape}; "
                    f"expected {(width, width)}"
                )
            block = slice(start, start + width)
            R[block, block] = channel.cov
            if channel.scale is not None:
                scales.append((block, channel.scale))
            start = block.stop
        return _Selection(plan, R, tuple(scales))
