"""The sections of a scenario file: names, types, defaults and units of all keys.

Unknown keys, wrong types (a text or true for a number) and numbers that no robot has are refused:
the range of a number belongs to its type. Quantities per coordinate (`PerName`) are a number, a
list, or a table of glob patterns; the last pattern that matches a coordinate applies.
"""

from typing import Annotated, Any, Literal

import tomli_w
from pydantic import AfterValidator, Field, model_validator

from estbench.scenario.log import LogSection
from estbench.scenario.quantities import (
    LONGEST,
    Count,
    Covariance,
    Delay,
    Duration,
    Factor,
    Index,
    NonNegative,
    Number,
    PerName,
    PerNameSquared,
    Positive,
    Probability,
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


class BelievedChannelSection(Section):
    """Parameters of a channel in which the filter's belief differs from the truth."""

    noise: PerName | None = Field(
        None, description="std per axis; an axis that a table does not name has the true one"
    )
    cov: Covariance | None = Field(None, description="full R")
    latency: Delay | None = Field(None, description="s; default: readings have time stamps")
    timestamps: Literal["taken", "due"] = Field(
        "taken", description="of readings with jitter: the sampling time, or the time they were due"
    )
    schedule: Schedule | None = Field(
        None, description="of the noise, instead of the true one; as `ChannelSection.schedule`"
    )
    follow_schedule: bool = Field(True, description="whether the filter knows the true schedule")


class BelievedNoiseSection(Section):
    """The process noise that the filter assumes in place of the true one.

    It follows the true schedule of factors. `filter.process_noise_scale` multiplies it.
    """

    kind: Literal["additive", "force", "actuator"] | None = Field(
        None, description="default the true kind"
    )
    density: PerNameSquared | None = Field(
        None,
        description="diagonal of Q_s, as `process_noise.density`; an axis that a table does not "
        "name has the true one, or none if the kind is another",
    )
    matrix: Covariance | None = Field(None, description="full Q_s instead of density")


class FilterSection(Section):
    """Parameters in which the filter's model differs from the truth.

    An estimator's own `filter` overrides them key by key.
    """

    path: str | None = Field(None, description="another MJCF with the same joints")
    timestep: Timestep | None = None
    integrator: Literal["Euler", "RK4", "implicit", "implicitfast"] | None = None
    set: dict[str, Number | list[Number]] = Field(default_factory=dict)
    process_noise: BelievedNoiseSection | None = Field(None, description="default the true one")
    process_noise_scale: Positive = Field(1.0, description="filter's Q over the true Q")
    measurement_noise_scale: Positive = Field(1.0, description="filter's R over the true R")
    channels: dict[str, BelievedChannelSection] = Field(default_factory=dict)
    delays: Literal["exact", "naive"] = Field(
        "exact", description="late readings: go back and replay, or fuse as if current"
    )
    window: Duration | None = Field(
        None, description="s that exact delay handling can go back; default the longest latency"
    )
    differences: Literal["forward", "centered"] = "forward"
    step: Annotated[float, Field(gt=0, lt=1)] = Field(1e-6, description="difference step")


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


class AddSensor(Section):
    """A MuJoCo sensor that is added to the model without a change of its XML."""

    type: str = Field(description="MJCF element name, e.g. jointpos, gyro, framepos")
    object: str | int | list[str | int] = Field(
        "",
        description="name or index of the joint, site, body, ... it is attached to; a glob pattern "
        "or a list adds one channel OBJECT_NAME for each",
    )
    object_type: str | None = Field(None, description="joint, site, body, geom, ...; guessed")


def _not_negative(value: float | list[float]) -> float | list[float]:
    listed = isinstance(value, list)
    if any(v < 0 for v in (value if listed else [value])):
        got = f", got {value}" if listed else ""  # `_explain` shows a single number
        raise ValueError(f"Input should be greater than or equal to 0{got}")
    return value


PerAxis = Annotated[Number | list[Number], AfterValidator(_not_negative)]


class ChannelSection(Section):
    """Noise, timing and imperfections of a channel, in the unit of its reading."""

    noise: Number | list[Number] | None = Field(
        None, description="std per axis; default MJCF noise"
    )
    noise_density: Positive | None = Field(
        None, description="datasheet: unit/√Hz; the std is this times √rate"
    )
    cov: Covariance | None = Field(None, description="full R instead of noise")
    schedule: Schedule | None = Field(
        None, description="rows (until s, factor on the std), or function: factor(s), or full R"
    )
    bias: PerAxis = Field(0.0, description="std of a constant drawn once per run")
    bias_walk: PerAxis = Field(0.0, description="random walk, unit/√s")
    drift: PerAxis = Field(0.0, description="std of a Gauss-Markov drift")
    drift_time: Duration = Field(100.0, description="correlation time of the drift, s")
    bias_instability: Positive | None = Field(
        None, description="datasheet: minimum of the Allan deviation; sets a Gauss-Markov drift"
    )
    scale_factor: PerAxis = Field(0.0, description="std of the relative gain error")
    misalignment: NonNegative = Field(0.0, description="std of the rotation of 3 axes, rad")
    quantization: PerAxis = Field(0.0, description="step")
    counts_per_revolution: Positive | None = Field(
        None, description="datasheet: an encoder's resolution; the step is 2π over this"
    )
    cutoff: Positive | None = Field(None, description="saturation; default the MJCF's cutoff")
    deadband: PerAxis = Field(0.0, description="readings of smaller magnitude become zero")
    outlier_probability: Probability = 0.0
    outlier_scale: Factor = Field(10.0, description="factor on the noise of an outlier")
    student_dof: Annotated[float, Field(gt=2, le=LONGEST)] | None = Field(
        None, description="Student-t noise of covariance R with these degrees of freedom"
    )
    dropout: Probability = Field(0.0, description="share of readings lost")
    dropout_length: Factor = Field(
        1.0, description="mean length of a gap, readings; 1 = independent"
    )
    stuck: Probability = Field(
        0.0, description="probability per reading that a stuck-at fault begins"
    )
    stuck_length: Factor = Field(10.0, description="mean length of a fault, readings")
    rate: Positive | None = Field(
        None, description="Hz; default the MJCF's interval, else every step"
    )
    phase: Delay | None = Field(
        None, description="time of the first reading, s; default the MJCF's, else one period"
    )
    jitter: Delay = Field(0.0, description="largest deviation of the sampling time, s, uniform")
    latency: Delay | None = Field(None, description="s from sampling to arrival")
    latency_std: Delay = Field(0.0, description="std of the latency about its mean `latency`, s")
    enabled: bool = True
    cost: NonNegative | None = Field(None, description="for `estbench design`; default 1")
    add: AddSensor | None = None
    of: list[str] | None = Field(None, description="sensors that form one channel, with one R")
    axes: list[Index] | None = Field(
        None, description="indices of the axes that are measured, from 0; default all"
    )
    function: str | None = Field(
        None, description="module:function(x, u, t) -> y instead of a sensor"
    )
    unit: str | None = Field(None, description="of a function's reading")
    angles: list[Index] | None = Field(
        None, description="indices of a function's outputs that are angles in rad, modulo 2π"
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
