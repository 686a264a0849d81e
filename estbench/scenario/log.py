"""The section `[log]` of a scenario: where the columns of a log go, and what its clock counts."""

from typing import Annotated, Literal

from pydantic import Field

from estbench.scenario.quantities import (
    Delay,
    Duration,
    NonNegative,
    Number,
    Positive,
    Section,
)

Clock = Literal["s", "ms", "us", "ns"]
"""Units of time stamps."""


class LogColumns(Section):
    """The columns of one channel or of some controls: value = scale unit raw + offset."""

    columns: Annotated[list[str], Field(min_length=1)] = Field(
        description="names of columns, in the order of the axes of the reading"
    )
    unit: str | None = Field(None, description="of the columns, such as deg; default the SI unit")
    scale: Number = Field(1.0, description="factor on every axis; -1 turns the sign")
    offset: Number | list[Number] = Field(0.0, description="added last, in the SI unit; per axis")


class LogChannel(LogColumns):
    """The columns of one channel."""

    time: str | None = Field(None, description="column of its time stamps; default that of [log]")
    taken: str | None = Field(
        None, description="column of the time at which it was taken, if `time` is that of arrival"
    )
    latency: Number = Field(0.0, description="s by which it was taken before its time stamp")


class TruthColumns(LogColumns):
    """The columns of a part of the true state."""

    time: str | None = Field(None, description="column of its time stamps; default that of truth")
    noise: NonNegative | list[NonNegative] = Field(
        0.0, description="σ of the truth itself, of each tangent coordinate, in SI units"
    )


class TruthSection(Section):
    """Where a log has the true state, as of motion capture."""

    time: str | None = Field(None, description="column of its time stamps; default that of [log]")
    offset: Number = Field(0.0, description="s that are added to its time stamps")
    longest_gap: Positive = Field(0.1, description="s over which it is interpolated at most")
    frame: Literal["model", "given", "estimated"] = Field(
        "model",
        description="its frame: that of the model, one that `translation` and `rotation` turn into "
        "it, or one that is fitted to the estimated positions (Umeyama)",
    )
    translation: Annotated[list[Number], Field(min_length=3, max_length=3)] = Field(
        [0.0, 0.0, 0.0], description="m; x_model = R x_truth + translation"
    )
    rotation: Annotated[list[Number], Field(min_length=4, max_length=4)] = Field(
        [1.0, 0.0, 0.0, 0.0], description="R as a quaternion w, x, y, z"
    )
    states: dict[str, TruthColumns] = Field(
        default_factory=dict,
        description="a joint, JOINT.vel, JOINT.position, JOINT.rotation or one number of the state",
    )


class LogSection(Section):
    """How a recorded log is read; see docs/logs.md."""

    time: str | None = Field(None, description="column of the time stamps; default found by name")
    unit: Clock = Field("s", description="of the time stamps")
    skip: Delay = Field(0.0, description="s that are left out at the start")
    duration: Duration | None = Field(None, description="s that are read; default all")
    hold: Literal["previous", "next", "linear"] = Field(
        "previous",
        description="the control between two of its time stamps: that of the first, of the second, "
        "or interpolated",
    )
    delay: Number = Field(0.0, description="s from the time stamp of a control to its effect")
    longest_hold: Positive | None = Field(
        None, description="s for which a control is held at most; default 10 of its usual intervals"
    )
    instants: Literal["readings", "all"] = Field(
        "readings",
        description="what the filter predicts to: the time stamps of readings, under the mean "
        "control in between; or those of controls too",
    )
    channels: dict[str, LogChannel] = Field(default_factory=dict)
    controls: dict[str, LogColumns] = Field(
        default_factory=dict, description="actuator = where it is; one that is left out is at rest"
    )
    truth: TruthSection | None = Field(None, description="where the true state is")
