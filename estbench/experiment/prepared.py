"""A resolved experiment: the objects that all runs share, and those of one batch."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from estbench.errors import ScenarioError
from estbench.estimators import registry
from estbench.estimators.of_state import OfState
from estbench.estimators.protocol import Estimator, depends_on_time
from estbench.experiment.believed import Believed
from estbench.inference import initialization as starting
from estbench.inference.fusion import Delays
from estbench.models.differences import Differences
from estbench.models.seen_noise import SeenNoise
from estbench.robots import parameters
from estbench.robots.disturbance import Disturbance
from estbench.robots.measurement import needed_stage
from estbench.robots.model import MujocoModel
from estbench.scenario import load as scenarios
from estbench.scenario import reference
from estbench.scenario.believed import LOOP
from estbench.scenario.filter import FilterSection
from estbench.scenario.schema import Scenario, StartSection
from estbench.sensors.channel import Channel
from estbench.sensors.description import sight
from estbench.sensors.instants import Instant, Instants
from estbench.sensors.timing import Schedule
from estbench.shapes import Array, Float
from estbench.simulation import controllers
from estbench.simulation.initial import InitialStates
from estbench.simulation.truth import Simulator
from estbench.spaces.manifold import Manifold


@dataclass(frozen=True)
class Timeline:
    """The time of a recorded log, in place of that of the simulation.

    Attributes:
        tick: length of one tick of the instants, s.
        window: how far exact handling of late readings goes back by default, in ticks.
    """

    tick: float
    window: int


@dataclass(frozen=True, eq=False)
class Setup:
    """The objects that all runs share; its methods build those of one batch.

    Attributes:
        scenario: what it was built from.
        plant: the nominal robot: truth model, state space, keyframe, control period.
        channels: the true sensors.
        instants: the event loop's schedule.
        disturbance: the true process noise.
        shared: what the estimators believe of the robot, by the scenario's `[filter]`.
        believed: label -> what that estimator believes.
        initial: how the true states at the start are drawn.
        mean, cov: x̂₀ and P₀, the moments of these draws.
        notices: assumptions where the scenario says nothing.
        reference: the experiment of the estimator whose estimate the controller sees, with the
            label `estbench.scenario.reference.LABEL`; None where it sees something else.
        timeline: of a log; None where the instants count physics steps.
    """

    scenario: Scenario
    plant: controllers.Plant
    channels: tuple[Channel, ...]
    instants: Sequence[Instant]
    disturbance: Disturbance
    shared: Believed
    believed: Mapping[str, Believed]
    initial: InitialStates
    mean: Float[Array, " nx"]
    cov: Float[Array, "n n"]
    notices: tuple[str, ...]
    reference: "Setup | None" = None
    timeline: Timeline | None = None

    @property
    def space(self) -> Manifold:
        """The state space."""
        return self.plant.space

    @property
    def times(self) -> Float[Array, " time"]:
        """The start, and the end of every instant, s."""
        if isinstance(self.instants, Instants):
            return self.instants.times
        return np.array([0.0, *(i.end for i in self.instants)])

    @property
    def steps(self) -> int:
        """Control steps of each run; readings between them add instants."""
        if isinstance(self.instants, Instants):
            return self.instants.controls
        return sum(i.control for i in self.instants)

    def model(
        self,
        nthread: int | None = 1,
        robot: mujoco.MjModel | None = None,
        believed: Believed | None = None,
    ) -> MujocoModel:
        """A new filter model: one per thread, or of another `robot` with the same state.

        Args:
            nthread: threads of its backend; see `robots.backend.create`.
            robot: in place of that of `believed`.
            believed: default that of the scenario's `[filter]`.
        """
        side = believed or self.shared
        return MujocoModel(
            robot or side.robot,
            side.channels,
            side.disturbance,
            Differences(side.section.differences, side.section.step),
            nthread,
            self.plant.u0,
            split=self.timeline is not None,
        )

    @property
    def channel_spaces(self) -> dict[str, Manifold]:
        """Channel -> the manifold of its readings, in the measurement's order."""
        return {c.name: c.space for c in self.channels}

    def estimator(self, label: str, nthread: int | None = 1) -> Estimator:
        """A new estimator of that label on a new model, with the start of the scenario."""
        model = self._with_noise(self.model(nthread, believed=self.believed[label]))
        start = self.start(label)
        settings = self.settings(label)
        if isinstance(settings.get("models"), list):
            settings["models"] = [self._varied(label, table) for table in settings["models"]]
        made = registry.create(label, settings, model)
        if start.method != "prior":
            made = starting.WarmStart(made, model, start.window, start.method)
        return OfState.of(made, model) if isinstance(model, SeenNoise) else made

    @property
    def seen(self) -> bool:
        """Whether sensors see the disturbance."""
        return self.scenario.process_noise.accelerometer_sees == "disturbance"

    @property
    def sight(self) -> str:
        """What the sensors of accelerations and forces see of the disturbance; empty for none."""
        if self.disturbance.kind == "additive" or not self.disturbance.rank:
            return ""
        model, acceleration = self.plant.model, int(mujoco.mjtStage.mjSTAGE_ACC)
        names = [
            channel.name
            for channel in self.channels
            if needed_stage(model, channel.measurand.sensors) >= acceleration
        ]
        return sight(names, self.seen)

    def _with_noise(self, model: MujocoModel) -> MujocoModel | SeenNoise:
        """The model that the estimators get: with the disturbance in its state where it is seen."""
        noise = model.disturbance
        seen = self.seen and noise.rank and noise.kind != "additive"
        return SeenNoise(model) if seen else model

    def _varied(self, label: str, changes: Any) -> MujocoModel | SeenNoise:
        """The filter's model with some parameters set, as one of the `models` of an estimator."""
        where = f"estimators.{label}.models"
        if not isinstance(changes, dict):
            raise ScenarioError(
                f"{where}: {changes!r} is no table; use one like that of filter.set"
            )
        side = self.believed[label]
        robot = parameters.changed(side.robot, changes, where)
        return self._with_noise(self.model(robot=robot, believed=side))

    def depends_on_time(self, label: str) -> bool:
        """Whether what the estimator of that label computes may depend on the time.

        It does with a schedule, a function of the state (it is given the time), a `clock` sensor,
        a fit of the first readings, and an estimator that says so (`TimeDependent`). A user's own
        estimator may always depend on the time.
        """
        estimator = registry.resolve(str(self.settings(label).get("type", label)))
        side = self.believed[label]
        return bool(
            self.start(label).method != "prior"
            or side.disturbance.schedule is not None
            or any(channel.scale is not None for channel in side.channels)
            or any(c.measurand.depends_on_time(self.plant.model) for c in self.channels)
            or not estimator.__module__.startswith("estbench.")
            or depends_on_time(self.estimator(label))
        )

    def is_reference(self, label: str) -> bool:
        """Whether the estimator of that label gives the estimates of the reference, to the bit.

        It does if it has its settings, start and model, and draws no random numbers.
        """
        scenario, table = self.scenario, self.scenario.control.estimator
        return (
            isinstance(table, dict)
            and {"type": label, **scenario.estimators[label]} == table
            and reference.is_ekf(table)
            and scenario.start == StartSection()
            and self.believed[label].section == FilterSection()
        )

    def settings(self, label: str) -> dict[str, Any]:
        """The estimator's own settings, without those of the event loop."""
        settings = self.scenario.estimators[label]
        return {k: v for k, v in settings.items() if k not in LOOP}

    def start(self, label: str) -> StartSection:
        """How the estimator of that label starts."""
        return scenarios.start(self.scenario, label)

    def prior(self, label: str) -> tuple[Float[Array, " nx"], Float[Array, "n n"]]:
        """x̂₀ and P₀ of the estimator of that label."""
        start, nq, nv = self.start(label), self.plant.model.nq, self.plant.model.nv
        mean, cov = starting.displaced(self.space, self.mean, self.cov, start.offset, start.inflate)
        if start.method == "static":
            speeds = slice(nq, nq + nv), slice(nv, 2 * nv)
            mean, cov = starting.at_rest(mean, cov, *speeds, start.rest_std)
        return mean, cov

    def delays(self, label: str) -> Delays:
        """How the estimator of that label handles late readings."""
        section = self.believed[label].section
        believed = {
            name: round(channel.latency / self._tick)
            for name, channel in section.channels.items()
            if channel.latency is not None
        }
        nominal = frozenset(n for n, c in section.channels.items() if c.timestamps == "due")
        return Delays(section.delays, self._window(section), believed, nominal)

    @property
    def window(self) -> int:
        """The longest time that exact delay handling goes back by `[filter]`, in physics steps."""
        return self._window(self.scenario.filter)

    @property
    def _tick(self) -> float:
        """Length of one tick, s."""
        return float(self.plant.model.opt.timestep) if self.timeline is None else self.timeline.tick

    def _window(self, section: FilterSection) -> int:
        if section.window is not None:
            return int(section.window / self._tick + 1e-9)
        if self.timeline is not None:
            return self.timeline.window
        timestep = self._tick
        late = [c.timing.longest_delay for c in self.channels]
        late += [round((c.latency or 0.0) / timestep) for c in section.channels.values()]
        # A reading is fused at the first instant after its arrival, up to one interval later.
        slack = 0
        if any(late):
            known = isinstance(self.instants, Instants)
            slack = self.instants.longest if known else max(i.nstep for i in self.instants)
        return max(late, default=0) + slack

    def simulator(self, runs: Sequence[int]) -> Simulator:
        """The true robots of some runs at their start."""
        out = self.robots(len(runs), self.instants)
        u0 = np.repeat(self.plant.u0[None], len(runs), axis=0)
        out.start(np.arange(len(runs)), self.scenario.simulation.seed, runs, u0)
        return out

    def robots(
        self,
        rows: int,
        instants: Sequence[Instant] | None = None,
        nthread: int | None = 1,
        look: bool = False,
        timed: bool = False,
    ) -> Simulator:
        """The true robot in many rows; see `Simulator`."""
        return Simulator(
            self.plant.model,
            self.space,
            self.channels,
            self.schedule,
            self.disturbance,
            self.initial,
            self.scenario.truth.draw,
            rows,
            instants,
            nthread,
            look,
            timed,
            self.seen,
        )

    @property
    def schedule(self) -> Schedule:
        """The instants of an episode without an end."""
        named = [(c.name, c.timing) for c in self.channels]
        return Schedule(named, float(self.plant.model.opt.timestep), self.plant.nstep)

    def controller(self, runs: Sequence[int]) -> controllers.Controller:
        """The controller for some runs; its errors name it."""
        section = self.scenario.control
        steps = self.steps
        seed = self.scenario.simulation.seed
        made = controllers.build(section, self.plant, seed, runs, steps)
        name = section.function if section.kind == "user" else section.kind
        return controllers.checked(made, name or section.kind, self.plant.model.nu)
