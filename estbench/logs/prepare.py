"""A scenario on a log: the robot and the estimators, with the instants of the log."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from estbench.errors import LogError, did_you_mean
from estbench.experiment.prepared import Setup, Timeline
from estbench.experiment.setup import build
from estbench.logs import clock, files, truth
from estbench.logs.source import Log, mapped
from estbench.logs.table import LogTable
from estbench.logs.truth import Truth
from estbench.robots.layout import control_names
from estbench.scenario.log import LogSection
from estbench.scenario.schema import ControlSection, Scenario


def prepare(
    scenario: Scenario, logs: Sequence[str | Path], held_out: Sequence[str] = ()
) -> tuple[Setup, Log]:
    """The experiment and the log that it is run on.

    Args:
        scenario: with its section `[log]`.
        logs: the files.
        held_out: channels that are predicted and not fused.

    Raises:
        LogError: the scenario has no `[log]`, or the log does not fit it.
        EstbenchError: as `experiment.setup.build`.
    """
    section = _section(scenario, held_out)
    tables = files.read_all(logs)
    return laid_on(build(_on_a_log(scenario, section)), tables)


def built(scenario: Scenario, held_out: Sequence[str] = ()) -> Setup:
    """The experiment of a scenario with a section `[log]`, before a log is mapped to it.

    Channels that the log does not have are left out, and what the simulation alone needs.

    Raises:
        LogError: the scenario has no `[log]`, or none of a channel that is held out.
        EstbenchError: as `experiment.setup.build`.
    """
    return build(_on_a_log(scenario, _section(scenario, held_out)))


def _section(scenario: Scenario, held_out: Sequence[str]) -> LogSection:
    """The section `[log]`, checked."""
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
    return section


def _on_a_log(scenario: Scenario, section: LogSection) -> Scenario:
    changes = {"sensors": list(section.channels), "control": ControlSection(), "bound": False}
    return scenario.model_copy(update=changes)


def laid_on(prepared: Setup, tables: Sequence[LogTable]) -> tuple[Setup, Log]:
    """An experiment on the files of a log, by its section `[log]`.

    Raises:
        LogError: the log does not fit the robot.
    """
    section = prepared.scenario.log
    assert section is not None
    log = mapped(
        tables, section, prepared.channel_spaces, control_names(prepared.plant.model),
        prepared.plant.u0, prepared.scenario.filter.window,
    )  # fmt: skip
    ready = on(prepared, log)
    return ready, replace(log, truth=_truth(ready, log, tables, section))


def on(prepared: Setup, log: Log) -> Setup:
    """An experiment at the instants of a log, which is one run."""
    simulation = prepared.scenario.simulation.model_copy(update={"runs": 1})
    scenario = prepared.scenario.model_copy(update={"simulation": simulation})
    timeline = Timeline(clock.TICK, log.lateness)
    return replace(prepared, scenario=scenario, instants=log.instants, timeline=timeline)


def _truth(
    prepared: Setup, log: Log, tables: Sequence[LogTable], section: LogSection
) -> Truth | None:
    """The true state at the instants, in the frame of the log."""
    if section.truth is None:
        return None
    space = prepared.space
    found = truth.parts(tables, section, section.truth, space, log.start)
    return truth.at_times(found, section.truth, space, prepared.times)
