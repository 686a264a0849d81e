"""What `import estbench` shows, to people and to type checkers."""

import ast
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

import estbench

SCRIPT = """
from typing import assert_type

import numpy as np
import estbench

model = estbench.LinearModel(A=np.eye(2), C=np.eye(2), Q=np.eye(2), R=np.eye(2))
estimator: estbench.Estimator = estbench.EKF(model)
history = estbench.follow(estimator, np.zeros((1, 2)), np.eye(2)[None], np.zeros((5, 1, 2)))
smoothable: estbench.FilterHistory = history  # what a smoother takes
assert_type(estbench.run("pendulum", ["ekf"], runs=2), estbench.Results)
"""

HEAVY = {"mujoco", "numpy", "jaxtyping", "xarray", "zarr", "scipy", "gymnasium", "matplotlib"}


def test_the_public_names():
    shown = dir(estbench)
    assert shown == sorted([*estbench.__all__, "__version__"])
    assert {"run", "load", "open_results", "follow", "Scenario", "Results"} < set(shown)
    assert {"EKF", "UKF", "Estimator", "MujocoModel", "EstbenchError"} < set(shown)
    for name in estbench.__all__:
        assert getattr(estbench, name).__name__ == name
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        estbench.nothing  # noqa: B018


def test_type_checkers_are_told_of_every_name():
    tree = ast.parse(Path(str(estbench.__file__)).read_text())
    checked = next(
        node for node in tree.body
        if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING"
    )  # fmt: skip
    told = {
        alias.name: line.module
        for line in checked.body if isinstance(line, ast.ImportFrom)
        for alias in line.names
    }  # fmt: skip
    assert told == {name: f"estbench.{module}" for name, module in estbench._HOME.items()}
    assert told.keys() == set(estbench.__all__)


def test_nothing_heavy_is_imported_before_it_is_used():
    code = "import sys, estbench; dir(estbench); print(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert not {*HEAVY, "pydantic", "typer", "rich"} & set(loaded.stdout.split())


def test_a_users_script_passes_mypy(tmp_path):
    pytest.importorskip("mypy")
    good, bad = tmp_path / "good.py", tmp_path / "bad.py"
    good.write_text(SCRIPT)
    bad.write_text(
        textwrap.dedent("""
        import estbench

        estbench.run(runs="many")
        estbench.EKF()
        estbench.follow(None)
    """)
    )
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--no-incremental", "--strict", "good.py", "bad.py"],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert "good.py" not in done.stdout, done.stdout
    for line in (4, 5, 6):
        assert f"bad.py:{line}: error" in done.stdout, done.stdout


@pytest.mark.parametrize(
    ("arguments", "said", "unneeded"),
    [
        ("--help", "Which filter", {"pydantic", "estbench.scenario"}),
        ("list", "cartpole", {"rich.progress", "estbench.scenario.schema"}),
        ("run cartpol", "did you mean 'cartpole'", {"estbench.scenario.schema"}),
        ("check pendulm.toml", "no file 'pendulm.toml'", {"estbench.scenario.schema"}),
        ("check pendulum --set simulation.rums=3", "did you mean 'runs'", set()),
        ("run pendulum -e efk", "did you mean 'ekf'", set()),
    ],
)
def test_what_a_command_does_not_need_is_not_imported(arguments, said, unneeded):
    code = f"import sys; from estbench.commands.cli import main; sys.argv[1:] = {arguments.split()}"
    code += "\ntry: main()\nexcept SystemExit: pass\nprint('modules:', *sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    shown, _, modules = done.stdout.rpartition("modules:")
    assert said in shown + done.stderr
    assert not (HEAVY | unneeded) & set(modules.split())
