"""The sections `[channels.NAME]` of a scenario: noise, timing and faults of a sensor."""

from typing import Annotated

from pydantic import AfterValidator, Field

from estbench.scenario.quantities import (
    LONGEST,
    Covariance,
    Delay,
    Duration,
    Factor,
    Index,
    NonNegative,
    Number,
    Positive,
    Probability,
    Schedule,
    Section,
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
