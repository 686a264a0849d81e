"""Small stores of the pendulum that the tests of resuming and of faults share."""

import xarray as xr

import estbench

ARGUMENTS = {"estimators": ["ekf"], "runs": 40, "duration": 0.3, "batch_size": 5}


def run(out, **options):
    return estbench.run("pendulum", **{**ARGUMENTS, **options}, out=out)


def same(a, b):
    with estbench.open_results(a) as x, estbench.open_results(b) as y:
        xr.testing.assert_identical(x.load(), y.load())
