"""Small stores that the tests of the report share."""

from functools import cache
from pathlib import Path

import pytest

import estbench
from estbench.report import sources
from estbench.report.rendering import render

needs_gl = pytest.mark.skipif(
    not render.available(), reason="neither OSMesa nor EGL: apt-get install libosmesa6"
)


@cache
def _store(base: Path, name: str) -> Path:
    settings = {
        "two": {"scenario": "pendulum", "estimators": ["ekf", "ukf"]},
        "full": {"scenario": "quadrotor", "estimators": ["ekf"], "keep": "full",
                 "runs": 3, "duration": 0.1},
        "bare": {"scenario": "pendulum", "estimators": ["ekf"], "keep": "summary"},
        "lost": {"scenario": "pendulum", "estimators": ["ekf"], "overrides": [
            "consistency.divergence_threshold=2.0", "consistency.divergence_duration=0.05",
            "filter.process_noise_scale=0.01"]},
    }[name]  # fmt: skip
    folder = base / name
    estbench.run(**({"runs": 12, "duration": 1.0, "out": folder, "batch_size": 5} | settings))  # pyright: ignore[reportArgumentType]
    return folder


@pytest.fixture(scope="session")
def store(tmp_path_factory):
    """A function from a name to a results folder."""
    base = tmp_path_factory.mktemp("stores")
    return lambda name: _store(base, name)


@pytest.fixture
def entries(store):
    return lambda name: sources.load([store(name)])
