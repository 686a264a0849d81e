"""No module needs what POSIX systems alone have."""

import pkgutil
import subprocess
import sys

import estbench

POSIX = ("fcntl", "resource", "grp", "pwd", "termios", "pty", "posix_ipc")
CODE = """
import importlib, sys
hidden, names = sys.argv[1].split(","), sys.argv[2].split(",")
# What others import where they find it: asyncio, multiprocessing and subprocess know both cases.
import gymnasium, mujoco, xarray, zarr, scipy.stats, filelock, typer, rich.progress, asyncio
import concurrent.futures.process, multiprocessing.pool, subprocess
for name in hidden:
    sys.modules[name] = None
for name in names:
    try:
        importlib.import_module(name)
    except ImportError as error:
        if any(f"'{h}'" in str(error) or h in str(error).split() for h in hidden):
            raise SystemExit(f"{name}: {error}")
    except Exception as error:  # an optional dependency that is missing names its extra
        if type(error).__name__ != "MissingExtraError":
            raise
print(len(names))
"""


def test_every_module_imports_without_posix_modules():
    found = [m.name for m in pkgutil.walk_packages(estbench.__path__, "estbench.")]
    names = [n for n in found if ".assets" not in n and "adapters" not in n and "__main__" not in n]
    done = subprocess.run(
        [sys.executable, "-c", CODE, ",".join(POSIX), ",".join(names)],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert int(done.stdout) > 250
