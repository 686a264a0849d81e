import copy
import os
import re
from pathlib import Path

import numpy as np
import pytest

import estbench
from estbench.robots import backend, mjcf
from estbench.robots.intervals import equal_steps
from tests.helpers import random_states, zoo_model

ROOT = Path(estbench.__file__).parent


def files_with(pattern):
    """Files of the package, the linked folders too, in which a line matches."""
    folders = os.walk(ROOT, followlinks=True)
    paths = [Path(top) / name for top, _, names in folders for name in names if name[-3:] == ".py"]
    return [
        path.relative_to(ROOT).as_posix()
        for path in paths
        if re.search(pattern, path.read_text(), re.MULTILINE)
    ]


def test_one_file_imports_mujocos_batch():
    pattern = r"mujoco\.batch import|import mujoco\.batch|from mujoco import .*\bbatch\b"
    assert files_with(pattern) == ["robots/batch.py"]


def test_one_file_makes_backends():
    assert files_with(r"\bBatchBackend\(") == ["robots/backend.py"]


def test_the_calls_do_not_depend_on_the_number_of_threads_or_of_rows():
    model = zoo_model("joints")
    x, u = random_states(model, 6)
    one, two = backend.create(model), backend.create(model, nthread=2)
    assert one.model is model
    assert one.nx == x.shape[1]
    for call in (lambda b, x, u: b.step(x, u, 0.0, 3), lambda b, x, u: b.flow(x, u, 0.0)):
        whole = call(one, x, u)
        np.testing.assert_array_equal(call(two, x, u), whole)
        np.testing.assert_array_equal(call(one, x[2:3], u[2:3]), whole[2:3])
        np.testing.assert_array_equal(call(one, x[:, None], u), whole[:, None])


@pytest.mark.parametrize("name", ["pendulum", "quadruped"])
def test_steps_of_any_length_are_those_of_a_model_with_that_timestep(name):
    model = mjcf.compile_model(mjcf.read(f"estbench:assets/{name}/{name}.xml"))
    other = copy.copy(model)
    other.opt.timestep = 0.7 * model.opt.timestep
    x = np.repeat(np.concatenate([mjcf.keyframe(model, None)[0]])[None], 3, axis=0)
    u = np.full((3, model.nu), 0.1)
    engine = backend.create(model)
    usual = engine.step(x, u, 0.0, 4)
    paced = engine.step(x, u, 0.0, 4, None, other.opt.timestep)
    assert np.array_equal(paced, backend.create(other).step(x, u, 0.0, 4))
    assert not np.array_equal(paced, usual)
    assert np.array_equal(engine.step(x, u, 0.0, 4), usual)  # it goes back
    assert equal_steps(4 * model.opt.timestep, model.opt.timestep) == (4, None)
    steps, length = equal_steps(3.3, 1.0)
    assert (steps, length) == (4, 3.3 / 4)
    assert equal_steps(0.2, 1.0) == (1, 0.2)
