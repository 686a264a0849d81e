"""The sections of a scenario: names, types, defaults and units of all that a TOML file may say.

Unknown keys and wrong types are refused. Quantities per coordinate (`PerName`) are a number, a
list, or a table of glob patterns, of which the last match counts.
"""

from typing import Annotated, Any, Literal

import tomli_w
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

PerName = float | list[float] | dict[str, float]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Probability = Annotated[float, Field(ge=0, lt=1)]
Schedule = Annotated[list[tuple[Positive, Positive]], Field(min_length=1)] | str
"""Rows (until s, factor): the factor holds up to that time; or `module:function`: t -> one factor,
one an axis, or the whole covariance."""


class Section(BaseModel):
    """A table of the scenario file."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class ModelSection(Section):
    """The MJCF and how it is stepped."""

    path: str = Field(description="MJCF file, relative to the scenario, or package:path/in/package")
    keyframe: str | int | None = Field(
        None, description="nominal state and control; default the first keyframe, else qpos0"
    )
    frame_skip: Annotated[int, Field(ge=1)] = Field(1, description="physics steps per filter step")
    timestep: Positive | None = Field(None, description="s; default the MJCF's")
    integrator: Literal["Euler", "RK4", "implicit", "implicitfast"] | None = None
    set: dict[str, float | list[float]] = Field(
        default_factory=dict, description="overrides 'field.object' = value, e.g. body_mass.pole"
    )


class Draw(Section):
    """A model parameter drawn once a run: value (1 + relative_std z) + std z, z ~ N(0, 1).

    z stays within ± 4.5 (`models.parameters.LIMIT`), so that a mass can be refused that might be
    drawn negative.
    """

    relative_std: Annotated[float, Field(ge=0)] = 0.0
    std: Annotated[float, Field(ge=0)] = 0.0


class TruthSection(Section):
    """Where the simulated robot differs from the MJCF."""

    set: dict[str, float | list[float]] = Field(default_factory=dict)
    draw: dict[str, Draw] = Field(default_factory=dict, description="'field.object' = {std...}")


class BelievedChannelSection(Section):
    """What the filter believes of a channel, where it differs from the truth."""

    noise: float | list[float] | None = Field(None, description="std per axis")
    cov: list[list[float]] | None = Field(None, description="full R")
    latency: NonNegative | None = Field(
        None, description="s; default: readings carry the time they were taken"
    )
    timestamps: Literal["taken", "due"] = Field(
        "taken", description="of readings with jitter: when they were taken, or were to be"
    )
    schedule: Schedule | None = Field(
        None, description="of the noise, in place of the true one; as `ChannelSection.schedule`"
    )
    follow_schedule: bool = Field(True, description="whether the filter knows the true schedule")


class FilterSection(Section):
    """Where the filter's belief differs from the truth."""

    path: str | None = Field(None, description="another MJCF with the same joints")
    timestep: Positive | None = None
    integrator: Literal["Euler", "RK4", "implicit", "implicitfast"] | None = None
    set: dict[str, float | list[float]] = Field(default_factory=dict)
    process_noise_scale: Positive = Field(1.0, description="filter's Q over the true Q")
    measurement_noise_scale: Positive = Field(1.0, description="filter's R over the true R")
    channels: dict[str, BelievedChannelSection] = Field(default_factory=dict)
    delays: Literal["exact", "naive"] = Field(
        "exact", description="late readings: roll back and replay, or fuse as if current"
    )
    window: Positive | None = Field(
        None, description="s that exact handling can go back; default the longest latency"
    )
    differences: Literal["forward", "centered"] = "forward"
    step: Annotated[float, Field(gt=0, lt=1)] = Field(1e-6, description="difference step")


class SimulationSection(Section):
    """How long, how often, from which seed."""

    duration: Positive = Field(5.0, description="s")
    runs: Annotated[int, Field(ge=1)] = 200
    seed: Annotated[int, Field(ge=0)] = 0


class InitialSection(Section):
    """x̂₀ (the keyframe, or these) and P₀; the true state is drawn from N(x̂₀, P₀)."""

    qpos: list[float] | None = None
    qvel: list[float] | None = None
    act: list[float] | None = None
    std: PerName = Field(0.05, description="per tangent coordinate, in its unit")
    cov: list[list[float]] | None = Field(None, description="full P₀ in place of std")


class StartSection(Section):
    """How the estimators start, where not from x̂₀ and P₀; `start` of one estimator goes before."""

    offset: PerName = Field(0.0, description="added to x̂₀: a wrong start")
    inflate: PerName = Field(1.0, description="factor on the standard deviations of P₀")
    method: Literal["prior", "batch", "static"] = Field(
        "prior", description="batch: fit the first readings; static: the same, at rest"
    )
    window: Positive = Field(0.2, description="s of readings for batch and static")
    rest_std: Positive = Field(0.01, description="static: std of the velocities, per s")


class ProcessNoiseSection(Section):
    """Spectral density Q_s of the disturbance, true and (scaled) assumed."""

    kind: Literal["additive", "force", "actuator"] = "additive"
    density: PerName | None = Field(
        None,
        description="diagonal of Q_s: (unit)²/s; forces (N or N m)² s; actuators (ctrl)² s; "
        "default 0.01 on what it can drive (additive: the velocities)",
    )
    matrix: list[list[float]] | None = Field(None, description="full Q_s in place of density")
    schedule: Schedule | None = Field(
        None, description="rows (until s, factor on Q_s), or function: factor(s), or full Q_s"
    )


class AddSensor(Section):
    """A MuJoCo sensor to add to a model without touching its XML."""

    type: str = Field(description="MJCF element name, e.g. jointpos, gyro, framepos")
    object: str = Field("", description="name of the joint, site, body, ... it is attached to")
    object_type: str | None = Field(None, description="joint, site, body, geom, ...; guessed")


def _not_negative(value: float | list[float]) -> float | list[float]:
    listed = isinstance(value, list)
    if any(v < 0 for v in (value if listed else [value])):
        got = f", got {value}" if listed else ""  # one number is shown by `_explain`
        raise ValueError(f"Input should be greater than or equal to 0{got}")
    return value


PerAxis = Annotated[float | list[float], AfterValidator(_not_negative)]


class ChannelSection(Section):
    """What a sensor does to the true reading; units are those of its reading."""

    noise: float | list[float] | None = Field(None, description="std per axis; default MJCF noise")
    noise_density: Positive | None = Field(
        None, description="datasheet: unit/√Hz; the std is this times √rate"
    )
    cov: list[list[float]] | None = Field(None, description="full R in place of noise")
    schedule: Schedule | None = Field(
        None, description="rows (until s, factor on the std), or function: factor(s), or full R"
    )
    bias: PerAxis = Field(0.0, description="std of a constant drawn once a run")
    bias_walk: PerAxis = Field(0.0, description="random walk, unit/√s")
    drift: PerAxis = Field(0.0, description="std of a Gauss-Markov drift")
    drift_time: Positive = Field(100.0, description="its correlation time, s")
    bias_instability: Positive | None = Field(
        None, description="datasheet: floor of the Allan deviation, made by a Gauss-Markov drift"
    )
    scale_factor: PerAxis = Field(0.0, description="std of the relative gain error")
    misalignment: NonNegative = Field(0.0, description="std of the rotation of 3 axes, rad")
    quantization: PerAxis = Field(0.0, description="step")
    counts_per_revolution: Positive | None = Field(
        None, description="datasheet: an encoder's resolution; the step is 2π over this"
    )
    cutoff: Positive | None = Field(None, description="saturation; default the MJCF's cutoff")
    deadband: PerAxis = Field(0.0, description="readings below this in size become zero")
    outlier_probability: Probability = 0.0
    outlier_scale: Annotated[float, Field(ge=1)] = Field(10.0, description="noise times this")
    student_dof: Annotated[float, Field(gt=2)] | None = Field(
        None, description="Student-t noise of covariance R with these degrees of freedom"
    )
    dropout: Probability = Field(0.0, description="share of readings lost")
    dropout_length: Annotated[float, Field(ge=1)] = Field(
        1.0, description="mean length of a gap, readings; 1 = independent"
    )
    stuck: Probability = Field(0.0, description="chance a reading of a stuck-at fault to begin")
    stuck_length: Annotated[float, Field(ge=1)] = Field(10.0, description="its mean, readings")
    rate: Positive | None = Field(
        None, description="Hz; default the MJCF's interval, else every step"
    )
    phase: NonNegative | None = Field(None, description="s before the first reading")
    jitter: NonNegative = Field(0.0, description="sampling time off by up to ± this, s, uniform")
    latency: NonNegative | None = Field(None, description="s from sampling to arrival")
    latency_std: NonNegative = Field(0.0, description="random latency: mean `latency`, this std, s")
    enabled: bool = True
    add: AddSensor | None = None
    of: list[str] | None = Field(None, description="sensors that are read together, with one R")
    axes: list[Annotated[int, Field(ge=0)]] | None = Field(
        None, description="the numbers of the reading that are measured, 0 the first; default all"
    )
    function: str | None = Field(
        None, description="module:function(x, u, t) -> y in place of a sensor"
    )
    unit: str | None = Field(None, description="of a function's reading")
    angles: list[Annotated[int, Field(ge=0)]] | None = Field(
        None, description="which of a function's numbers are angles, rad: ± π is the same bearing"
    )


class ControlSection(Section):
    """What drives the robot; see `estbench.simulation.controllers`."""

    kind: Literal["none", "constant", "sine", "random", "lqr", "csv", "user"] = "none"
    observe: Literal["truth", "estimate"] = "truth"
    value: PerName | None = Field(None, description="constant: control")
    amplitude: PerName = Field(0.0, description="sine: peak of each term")
    frequencies: list[Positive] = Field(default_factory=lambda: [0.5], description="sine: Hz")
    offset: Literal["keyframe", "zero"] = Field("keyframe", description="sine, random: centre")
    std: PerName = Field(0.0, description="random: standard deviation")
    time_constant: Positive = Field(0.2, description="random: s")
    state_weight: PerName = Field(1.0, description="lqr: diagonal of the state cost")
    control_weight: PerName = Field(1.0, description="lqr: diagonal of the control cost")
    path: str | None = Field(None, description="csv: columns t then one per actuator")
    function: str | None = Field(None, description="user: module:function(t, x) -> u")


class TaskSection(Section):
    """What a Gymnasium policy is rewarded for; see docs/gymnasium.md."""

    target: PerName = Field(0.0, description="goal minus keyframe, per tangent coordinate")
    state_weight: PerName = Field(1.0, description="cost of a squared distance from the goal")
    control_weight: PerName = Field(
        0.0, description="cost of a squared control minus the keyframe's"
    )
    alive: float = Field(1.0, description="reward of a step that stays within the bounds")
    bounds: dict[str, Positive] = Field(
        default_factory=dict,
        description="largest distance from the goal, per coordinate; beyond it the episode ends",
    )
    horizon: Positive | None = Field(None, description="s; default simulation.duration")


class ConsistencySection(Section):
    """How the verdict is made; see docs/statistics.md."""

    level: Annotated[float, Field(gt=0, lt=1)] = 0.95
    tolerance: Annotated[float, Field(ge=0)] = Field(
        0.05, description="ANEES/n within 1 ± this is consistent in practice"
    )
    burn_in: Annotated[float, Field(ge=0)] = Field(0.0, description="s left out at the start")
    divergence_threshold: Positive = Field(
        1000.0, description="a run diverges when NEES/n stays above this ..."
    )
    divergence_duration: Annotated[float, Field(ge=0)] = Field(0.5, description="... for this, s")


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

    @model_validator(mode="before")
    @classmethod
    def _no_empty_estimators(cls, data: Any) -> Any:
        if isinstance(data, dict) and data.get("estimators") == {}:
            raise ValueError("estimators is empty; name at least one, e.g. [estimators.ekf]")
        return data

    def to_toml(self) -> str:
        """The scenario as TOML that `load` reads back to the same value."""
        return tomli_w.dumps(self.model_dump(mode="json", exclude_none=True))
