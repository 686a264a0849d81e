"""The section `[filter]` of a scenario: what the filter believes that is not true."""

from typing import Annotated, Literal

from pydantic import Field

from estbench.scenario.quantities import (
    Covariance,
    Delay,
    Duration,
    Number,
    PerName,
    PerNameSquared,
    Positive,
    Schedule,
    Section,
    Timestep,
)


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
