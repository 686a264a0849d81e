"""A scenario on a log: the robot and the estimators, with the instants of the log."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from estbench.errors import LogError, did_you_mean
from estbench.experiment.prepared import Setup, Timeline
from estbench.experiment.setup import build
from estbench.logs import clock, files
from estbench.logs.source import Log, mapped
from estbench.robots.layout import control_names
from estbench.scenario.schema import ControlSection, Scenario


def prepare(
    scenario: Scenario, logs: Sequence[str | Path], held_out: Sequence[str] = ()
) -> tuple[Setup, Log]:
    """The experiment and the log that it is run on.

    Channels that the log does not have are left out, and what the simulation alone needs.

    Args:
        scenario: with its section `[log]`.
        logs: the files.
        held_out: channels that are predicted and not fused.

    Raises:
        LogError: the scenario has no `[log]`, or the log does not fit it.
        EstbenchError: as `experiment.setup.build`.
    """
    section = scenario.log
    if section is None:
        raise LogError(
            f"scenario '{scenario.name}' has no section [log]; `estbench replay --inspect LOG` "
            "writes a first one"
        )
    if not section.channels:
        raise LogError("log.channels is empty; map at least one channel to columns of the log")
    for name in held_out:
        if name not in section.channels:
            raise LogError(
                f"--hold-out {name}: [log] has no such channel"
                f"{did_you_mean(name, section.channels)}"
            )
    if set(held_out) == set(section.channels):
        raise LogError("--hold-out names all channels of [log]; leave one to be fused")
    tables = files.read_all(logs)
    changes = {"sensors": list(section.channels), "control": ControlSection(), "bound": False}
    prepared = build(scenario.model_copy(update=changes))
    log = mapped(
        tables, section, prepared.channel_spaces, control_names(prepared.plant.model),
        prepared.plant.u0, scenario.filter.window,
    )  # fmt: skip
    timeline = Timeline(clock.TICK, log.lateness)
    return replace(prepared, instants=log.instants, timeline=timeline), log
