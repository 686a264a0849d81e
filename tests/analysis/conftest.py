import shutil

import pytest
import zarr

import estbench

COMMON = {"runs": 24, "duration": 0.2, "batch_size": 8, "workers": 2}


@pytest.fixture(scope="session")
def stores(tmp_path_factory):
    """Name -> results: two of one scenario and seed, one of another seed, one of another robot."""
    folder = tmp_path_factory.mktemp("stores")
    labels = ["ekf", "ukf", "kf", "ckf", "iekf", "sr_ekf"]
    wrong = ["filter.process_noise_scale=300"]
    return {
        "a": estbench.run("cartpole", labels, out=folder / "a", **COMMON),
        "b": estbench.run(
            "cartpole", ["ekf"], out=folder / "b", keep="summary", overrides=wrong, **COMMON
        ),
        "seed": estbench.run(
            "cartpole", ["ekf"], seed=1, out=folder / "seed", **COMMON, keep="summary"
        ),
        "pendulum": estbench.run(
            "pendulum", ["ekf"], out=folder / "pendulum", **COMMON, keep="summary"
        ),
    }


@pytest.fixture
def unfinished(stores, tmp_path):
    """A copy of `a` in which the second of three batches is not done."""
    folder = tmp_path / "unfinished"
    shutil.copytree(stores["a"].folder, folder)
    done = zarr.open_group(str(folder / "data.zarr"), mode="r+")["done"]
    done[8:16] = False  # type: ignore[index]
    return folder
