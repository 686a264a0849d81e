"""The sections of a scenario file: names, types, defaults and units of all keys.

Unknown keys, wrong types (a text or true for a number) and numbers that no robot has are refused:
the range of a number belongs to its type. Quantities per coordinate (`PerName`) are a number, a
list, or a table of glob patterns; the last pattern that matches a coordinate applies.
"""

from typing import Annotated, Any, Literal

import tomli_w
from pydantic import Field, model_validator

from estbench.scenario.channels import ChannelSection
from estbench.scenario.filter import FilterSection
from estbench.scenario.log import LogSection
from estbench.scenario.quantities import (
    Count,
    Covariance,
    Delay,
    Duration,
    Index,
    NonNegative,
    Number,
    PerName,
    PerNameSquared,
    Positive,
    Schedule,
    Section,
    Timestep,
)


class ModelSection(Section):
    """The MJCF and its integration."""

    path: str = Field(description="MJCF file, relative to the scenario, or package:path/in/package")
    keyframe: str | int | None = Field(
        None, description="nominal state and control; default the first keyframe, else qpos0"
    )
    frame_skip: Count = Field(1, description="physics steps per filter step")
    timestep: Timestep | None = Field(None, description="s; default the MJCF's")
    integrator: Literal["Euler", "RK4", "implicit", "implicitfast"] | None = None
    set: dict[str, Number | list[Number]] = Field(
        default_factory=dict, description="overrides 'field.object' = value, e.g. body_mass.pole"
    )


class Draw(Section):
    """A model parameter drawn once per run: value (1 + relative_std z) + std z, z ~ N(0, 1).

    z is limited to ± 4.5 (`robots.parameters.LIMIT`), so that a spread that could give a negative
    mass is known and refused.
    """

    relative_std: NonNegative = 0.0
    std: NonNegative = 0.0


class TruthSection(Section):
    """Parameters in which the simulated robot differs from the MJCF."""

    set: dict[str, Number | list[Number]] = Field(default_factory=dict)
    draw: dict[str, Draw] = Field(default_factory=dict, description="'field.object' = {std...}")


class SimulationSection(Section):
    """Duration, count of runs, and seed."""

    duration: Duration = Field(5.0, description="s")
    runs: Count = 200
    seed: Annotated[int, Field(ge=0, le=2**63 - 1)] = 0


class InitialSection(Section):
    """x̂₀ (the keyframe, or these) and P₀; the true state is drawn from N(x̂₀, P₀)."""

    qpos: list[Number] | None = None
    qvel: list[Number] | None = None
    act: list[Number] | None = None
    std: PerName = Field(
        0.05,
        description="per tangent coordinate, in its unit; default 0.005 with equality constraints",
    )
    cov: Covariance | None = Field(None, description="full P₀ in place of std")
    constraints: Literal["auto", "none", "equality", "all"] = Field(
        "auto",
        description="what states at the start are projected to, and P₀ with them: equality "
        "constraints; all: out of contacts deeper than 1 cm too; auto: all if neither std nor cov "
        "is given, else equality",
    )


class StartSection(Section):
    """How the estimators start, if not from x̂₀ and P₀; an estimator's own `start` overrides it."""

    offset: PerName = Field(0.0, description="added to x̂₀: an initial error")
    inflate: PerName = Field(1.0, description="factor on the standard deviations of P₀")
    method: Literal["prior", "batch", "static"] = Field(
        "prior", description="batch: fit the first readings; static: the same for a robot at rest"
    )
    window: Duration = Field(0.2, description="s of readings for batch and static")
    rest_std: Positive = Field(0.01, description="static: std of the velocities, per s")


class ProcessNoiseSection(Section):
    """Spectral density Q_s of the true disturbance; the filter's is a multiple of it."""

    kind: Literal["additive", "force", "actuator"] = "additive"
    density: PerNameSquared | None = Field(
        None,
        description="diagonal of Q_s: (unit)²/s; forces (N or N m)² s; actuators (ctrl)² s; "
        "default 0.01 on every axis (additive: the velocities; force: scaled so that the "
        "velocities gain 0.01 (unit)²/s)",
    )
    matrix: Covariance | None = Field(None, description="full Q_s instead of density")
    schedule: Schedule | None = Field(
        None, description="rows (until s, factor on Q_s), or function: factor(s), or full Q_s"
    )
    accelerometer_sees: Literal["control", "disturbance"] = Field(
        "control",
        description="what sensors of accelerations and forces are read under: the commanded "
        "control alone, or the disturbance (force, actuator) of the last interval too",
    )


class ControlSection(Section):
    """The controller of the robot; see `estbench.simulation.controllers`."""

    kind: Literal["none", "constant", "sine", "random", "lqr", "periodic", "csv", "user"] = "none"
    observe: Literal["truth", "estimate", "reference"] = Field(
        "truth",
        description="what the controller sees: the true state, the estimate of each estimator "
        "under test, or that of `estimator`, which gives all of them the same truth",
    )
    estimator: str | dict[str, Any] | None = Field(
        None,
        description="reference: a label of the scenario, a name, or a table of settings with "
        "`type`; default the scenario's first exact EKF (see `estbench.scenario.reference`)",
    )
    value: PerName | None = Field(None, description="constant: control")
    amplitude: PerName = Field(0.0, description="sine: peak of each term")
    frequencies: list[Positive] = Field(default_factory=lambda: [0.5], description="sine: Hz")
    offset: Literal["keyframe", "zero"] = Field(
        "keyframe", description="sine, random: mean; periodic: the control at the start"
    )
    std: PerName = Field(0.0, description="random: standard deviation")
    time_constant: Duration = Field(0.2, description="random: s")
    state_weight: PerName = Field(1.0, description="lqr: diagonal of the state cost")
    control_weight: PerName = Field(1.0, description="lqr: diagonal of the control cost")
    period: Positive | None = Field(None, description="periodic: s")
    knots: dict[str, Annotated[list[float], Field(min_length=2)]] = Field(
        default_factory=dict,
        description="periodic: {pattern of controls: values at equal distances over one period}",
    )
    phase: PerName = Field(0.0, description="periodic: periods by which a control is ahead")
    begin: NonNegative = Field(0.0, description="periodic: s before it, at the start's control")
    ramp: NonNegative = Field(0.0, description="periodic: s from that control to the splines")
    path: str | None = Field(None, description="csv: columns t then one per actuator")
    function: str | None = Field(None, description="user: module:function(t, x) -> u")


class TaskSection(Section):
    """The reward of a Gymnasium environment; see docs/gymnasium.md."""

    target: PerName = Field(0.0, description="goal minus keyframe, per tangent coordinate")
    state_weight: PerName = Field(1.0, description="cost of a squared distance from the goal")
    control_weight: PerName = Field(
        0.0, description="cost of a squared control minus the keyframe's"
    )
    alive: Number = Field(1.0, description="reward per step within the bounds")
    bounds: dict[str, Positive] = Field(
        default_factory=dict,
        description="largest distance from the goal, per coordinate; beyond it the episode ends",
    )
    horizon: Duration | None = Field(None, description="s; default simulation.duration")


class ConsistencySection(Section):
    """The criteria of the verdict; see docs/statistics.md."""

    level: Annotated[float, Field(gt=0, lt=1)] = 0.95
    tolerance: NonNegative = Field(
        0.1, description="NEES/n and NIS/m within 1 ± this are consistent in practice"
    )
    burn_in: Delay = Field(0.0, description="s that are left out at the start")
    divergence_threshold: Positive = Field(
        1000.0, description="a run diverges when NEES/n stays above this ..."
    )
    divergence_duration: Delay = Field(0.5, description="... for this, s")


ContactEvent = Literal["touch-down", "lift-off", "slip", "limit"]


class ContactSection(Section):
    """Phases of contact of the true robot, by which statistics are shown; see docs/contact.md."""

    phases: bool | None = Field(
        None, description="whether; default where the robot's geoms may touch something"
    )
    events: Annotated[list[ContactEvent], Field(min_length=1)] = Field(
        default_factory=lambda: ["touch-down", "lift-off"],
        description="what counts as an event; slip: a contact begins to; limit: of a joint",
    )
    steps: Index = Field(3, description="control steps before and after an event that belong to it")
    slip: Positive = Field(0.05, description="m/s, tangential speed of a contact that slips")


class Scenario(Section):
    """One experiment; `load` reads it."""

    name: str
    description: str = ""
    sensors: list[str] | None = Field(None, description="channels in use; default all")
    model: ModelSection
    truth: TruthSection = TruthSection()
    filter: FilterSection = FilterSection()
    simulation: SimulationSection = SimulationSection()
    initial: InitialSection = InitialSection()
    start: StartSection = StartSection()
    process_noise: ProcessNoiseSection = ProcessNoiseSection()
    channels: dict[str, ChannelSection] = Field(default_factory=dict)
    control: ControlSection = ControlSection()
    task: TaskSection = TaskSection()
    estimators: dict[str, dict[str, Any]] = Field(
        default_factory=lambda: {"ekf": {}, "ukf": {}},
        description="label = {type = name, setting = value, ...}; type defaults to the label",
    )
    consistency: ConsistencySection = ConsistencySection()
    bound: bool | Literal["known"] = Field(
        True,
        description="whether the posterior Cramér-Rao bound is computed; 'known': for estimators "
        "that know the parameters drawn in each run",
    )
    contact: ContactSection = ContactSection()
    log: LogSection | None = Field(
        None, description="where a recorded log has the channels and the controls"
    )

    @model_validator(mode="before")
    @classmethod
    def _no_empty_estimators(cls, data: Any) -> Any:
        if isinstance(data, dict) and data.get("estimators") == {}:
            raise ValueError("estimators is empty; name at least one, e.g. [estimators.ekf]")
        return data

    def to_toml(self) -> str:
        """The scenario as TOML that `load` reads back to the same value."""
        return tomli_w.dumps(self.dumped("json"))

    def dumped(self, mode: Literal["python", "json"] = "python") -> dict[str, Any]:
        """The scenario as nested tables that validate to the same value.

        A std of the start that is not given is left out: its default depends on the robot.
        """
        data = self.model_dump(mode=mode, exclude_none=True)
        if "std" not in self.initial.model_fields_set:
            del data["initial"]["std"]
        return data
