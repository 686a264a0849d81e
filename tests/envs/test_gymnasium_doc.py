"""Every Python block of docs/gymnasium.md runs, and so does what it says to type."""

import logging
import re
import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner

from estbench.commands.cli import app
from estbench.scenario import load as scenario

TEXT = (Path(__file__).parents[2] / "docs" / "gymnasium.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)


@pytest.mark.parametrize("code", blocks("python"))
def test_python(code, caplog):
    caplog.set_level(logging.ERROR, "estbench")
    names = {}
    exec(compile(code, "docs/gymnasium.md", "exec"), names)
    for name in ("env", "envs"):
        if name in names:
            names[name].reset(seed=0)
            names[name].action_space.seed(0)
            names[name].step(names[name].action_space.sample())
            names[name].close()


def test_console():
    (line,) = re.findall(r"^\$ estbench (.*)$", "\n".join(blocks("console")), re.MULTILINE)
    arguments = [*shlex.split(line), "--duration", "0.05"]
    assert "100 runs" in CliRunner().invoke(app, arguments).output


def test_the_task_of_the_text_is_valid():
    (table,) = blocks("toml")
    given = [row.split("#")[0].strip() for row in table.splitlines()[1:]]
    loaded = scenario.load("pendulum", [f"task.{row}" for row in given if row])
    assert loaded.task.horizon == 5.0
    assert loaded.task.bounds == {"hinge.vel": 20.0}


def test_the_picture_is_there():
    (name,) = re.findall(r"!\[.*\]\((.*)\)", TEXT)
    assert (Path(__file__).parents[2] / "docs" / name).is_file()
