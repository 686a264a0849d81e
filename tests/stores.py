"""Small stores of the pendulum that the tests of resuming and of faults share."""

import json

import xarray as xr

import estbench
from estbench.store.metadata import COPY, INTEGRITY, STORE

ARGUMENTS = {"estimators": ["ekf"], "runs": 40, "duration": 0.3, "batch_size": 5}


def run(out, **options):
    return estbench.run("pendulum", **{**ARGUMENTS, **options}, out=out)


def same(a, b):
    with estbench.open_results(a) as x, estbench.open_results(b) as y:
        xr.testing.assert_identical(x.load(), y.load())


def unsealed(folder):
    """Take the checksums from a store, and from its metadata what the store lacks."""
    (folder / COPY).unlink()
    root = folder / STORE / "zarr.json"
    described = json.loads(root.read_text(encoding="utf-8"))
    del described["consolidated_metadata"], described["attributes"][INTEGRITY]
    root.write_text(json.dumps(described), encoding="utf-8")
