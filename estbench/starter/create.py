"""A scenario file for a robot: written once, never over another file."""

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from estbench.errors import EstbenchError, ScenarioError
from estbench.experiment import setup, unseen
from estbench.robots import mjcf
from estbench.scenario.load import load
from estbench.starter import control, text
from estbench.starter import sensors as sensing
from estbench.starter.robot import Robot

NAME = "scenario.toml"


def create(path: str, out: Path | None = None, sensors: Sequence[str] | None = None) -> Path:
    """Write a commented scenario for an MJCF, and return the path of the file.

    The sensors of the MJCF are on. Of `sensors.KINDS` those are on that `sensors` names; if it is
    None, those without which a coordinate is not observable. The others are comments.

    Args:
        path: of the MJCF, or `package:path/in/package`.
        out: the file; default `scenario.toml` beside the MJCF, in the current folder for a package.
        sensors: groups that are added and on.

    Raises:
        ScenarioError: the MJCF cannot be read, the robot has no joint, the file exists or cannot be
            written.
    """
    file = mjcf.locate(path)
    packaged = ":" in path and file != Path(path)
    out = out or (Path(NAME) if packaged else file.parent / NAME)
    if out.exists():
        raise ScenarioError(f"{out} exists; give another name by --out")
    robot = Robot.read(path)
    named = path if packaged else _relative(file, out.parent)
    content = _content(robot, named, sensors, path if packaged else str(file.resolve()))
    try:
        with out.open("x", encoding="utf-8") as target:
            target.write(content)
    except OSError as error:
        raise ScenarioError(f"{out} cannot be written: {error.strerror or error}") from None
    return out


def _content(robot: Robot, named: str, sensors: Sequence[str] | None, path: str) -> str:
    """The text, with the sensors that were asked for or that are needed."""
    own = sensing.own(robot)
    taken = [entry.name for entry in own]
    added = {group: sensing.missing(robot, group, taken) for group in sensing.KINDS}
    chosen = control.choose(robot)

    def entries(groups: Sequence[str]) -> list[sensing.Entry]:
        return own + [
            replace(entry, used=group in groups) for group in added for entry in added[group]
        ]

    if sensors is None:
        sensors = _needed(lambda groups: text.write(robot, path, entries(groups), chosen))
    return text.write(robot, named, entries(sensors), chosen)


def _needed(draft: Callable[[Sequence[str]], str]) -> tuple[str, ...]:
    """The fewest groups, in their order, with which every coordinate is observable."""
    tried: tuple[str, ...] = ()
    for more in (None, "encoders", "position"):
        tried = tried if more is None else (*tried, more)
        if _sees_all(draft(tried)):
            return tried
    return tried


def _sees_all(content: str) -> bool:
    """Whether some sensor is declared and no coordinate is unseen."""
    with TemporaryDirectory() as folder:
        file = Path(folder) / NAME
        file.write_text(content, encoding="utf-8")
        scenario = load(file)
        if not any(c.enabled for c in scenario.channels.values()):
            return False
        try:
            return not unseen.notice(setup.build(scenario))
        except EstbenchError:
            return False


def _relative(file: Path, folder: Path) -> str:
    """The path of a file from a folder; absolute where they have no folder in common."""
    try:
        return Path(os.path.relpath(file.resolve(), folder.resolve())).as_posix()
    except ValueError:  # another drive
        return str(file.resolve())
