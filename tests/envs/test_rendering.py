# pyright: reportOptionalMemberAccess=false, reportArgumentType=false
# pyright: reportOptionalSubscript=false, reportGeneralTypeIssues=false
import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).with_name("rendering_checks.py")


CHECKS = ["pictures", "vectors", "checks", "videos", "ellipsoids", "errors"]


def run(*command):
    env = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    return subprocess.run(
        [sys.executable, *command],
        env={**env, "MUJOCO_GL": "osmesa"},
        capture_output=True,
        text=True,
    )


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    if run("-c", "import mujoco; mujoco.GLContext(8, 8).make_current()").returncode:
        pytest.skip("no OSMesa: Debian's libosmesa6 is not installed")
    done = run(str(SCRIPT), str(tmp_path_factory.mktemp("video")))
    lines = [line.partition(": ") for line in done.stdout.splitlines()]
    return {name: said for name, _, said in lines} | {"stderr": done.stderr}


@pytest.mark.parametrize("check", CHECKS)
def test_rendering(check, results):
    assert results.get(check, results["stderr"]) == "ok"
