"""Size and time of a report of many runs: `python -m benchmarks.report --runs 100000`.

2000 runs of the pendulum (200 steps, EKF and UKF, traces in single precision) are simulated, and
repeated until there are as many as asked for: what a report costs does not depend on the values.
Target: 100,000 runs in a file under 20 MB in under a minute.
"""

import argparse
import tempfile
import time
import tomllib
from pathlib import Path
from typing import Any

import tomli_w
import zarr

import estbench
from estbench.report.html import write_report
from estbench.store.contents import SCENARIO
from estbench.store.metadata import STORE

RUNS, SECONDS = 2000, 2.0


def repeat(source: Path, target: Path, times: int) -> None:
    """Write a store of so many times the runs."""
    target.mkdir(parents=True)
    scenario = tomllib.loads((source / SCENARIO).read_text("utf-8"))
    scenario["simulation"]["runs"] *= times
    (target / SCENARIO).write_text(tomli_w.dumps(scenario), "utf-8")
    old = zarr.open_group(source / STORE, mode="r")
    new = zarr.open_group(target / STORE, mode="w")
    new.attrs.update(old.attrs)
    for path, array in old.members(max_depth=None):
        if not isinstance(array, zarr.Array):
            continue
        values: Any = array[...]
        dims = array.metadata.dimension_names or ()  # type: ignore[union-attr]
        count = times if dims and dims[0] in ("run", "batch") else 1
        shape = (count * array.shape[0], *array.shape[1:])
        copy = new.create_array(
            path, shape=shape, chunks=array.chunks, dtype=array.dtype, dimension_names=dims
        )
        for i in range(count):
            shifted = values + i * len(values) if path == "run" else values
            copy[i * len(values) : (i + 1) * len(values)] = shifted


def main() -> None:
    """Make a store, report it, print what it took."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=100_000)
    parser.add_argument("--keep", choices=("summary", "diagonal"), default="diagonal")
    wanted = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        small, large = Path(folder) / "small", Path(folder) / "large"
        estbench.run(
            "pendulum", ["ekf", "ukf"], runs=min(RUNS, wanted.runs), duration=SECONDS, out=small,
            keep=wanted.keep, dtype="float32",
        )  # fmt: skip
        repeat(small, large, max(1, wanted.runs // RUNS))
        size = sum(f.stat().st_size for f in large.rglob("*") if f.is_file())
        began, cpu = time.perf_counter(), time.process_time()
        path = write_report([large])
        print(
            f"{wanted.runs} runs, store of {size / 1e9:.2f} GB: {path.stat().st_size / 1e6:.1f} MB "
            f"in {time.perf_counter() - began:.0f} s ({time.process_time() - cpu:.0f} s of CPU)"
        )


if __name__ == "__main__":
    main()
