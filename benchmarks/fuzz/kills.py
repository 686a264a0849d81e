"""Runs that are killed (SIGKILL) at moments spread over their whole duration, then resumed."""

import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.fuzz.case import Case
from benchmarks.fuzz.stores import files

RUN = (
    "import sys, estbench; estbench.run('pendulum', 'ekf', runs=120, duration=0.5, batch_size=4, "
    "out=sys.argv[1], resume=sys.argv[2] == 'True')"
)


def _command(out: Path, resume: bool = False) -> list[str]:
    return [sys.executable, "-c", RUN, str(out), str(resume)]


def whole(out: Path) -> float:
    """The run that nobody kills; how long it takes, s."""
    began = time.monotonic()
    subprocess.run(_command(out), check=True, capture_output=True)
    return time.monotonic() - began


def cases(count: int, seed: int, out: Path) -> Iterator[Case]:
    """Kills of the run that `whole` has done in the folder `out`."""
    lasted = whole(out)
    for i in range(count):
        share = (i + float(np.random.default_rng((seed, 6, i)).random())) / count
        yield Case(f"killed after {share * lasted:.2f} s", _Kill(out, share * lasted))


class _Kill:
    def __init__(self, whole: Path, after: float):
        self._whole, self._after = whole, after

    def __call__(self, folder: Path) -> str:
        store = folder / "x"
        process = subprocess.Popen(
            _command(store), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        time.sleep(self._after)
        process.kill()
        process.wait()
        left = len(files(store)) if store.exists() else 0
        done = subprocess.run(
            _command(store, resume=True), capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        again = {p: (store / p).read_bytes() for p in files(store) if "costs" not in p.parts[0]}
        first = {p: (self._whole / p).read_bytes() for p in files(self._whole)}
        different = [str(p) for p, content in again.items() if first.get(p) != content]
        assert not different, f"differ: {different[:5]}"
        assert files(store) == files(self._whole), "other files"
        return f"{left} files when it was killed"
