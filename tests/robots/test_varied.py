"""A backend with parameters of each run, for any number of points."""

import mujoco
import numpy as np

from estbench.robots import backend
from estbench.robots.backend import Backend
from estbench.robots.varied import Parameter, VariedBackend
from tests.helpers import random_states, zoo_model

MODEL = zoo_model("joints")


def test_each_run_has_its_own_parameters_at_every_point():
    model = MODEL
    x, u = random_states(model, 3)
    mass = np.array([0.5, 1.0, 2.0])
    field, index = "dof_damping", slice(0, 1)
    made = VariedBackend(backend.create(model), [Parameter(field, index, mass[:, None])])
    assert isinstance(made, Backend)
    assert made.nx == x.shape[1]
    points = np.repeat(x[:, None], 4, axis=1)
    for a, b in zip(*(e.frames(x, ("xanchor", "xaxis")) for e in (made, backend.create(model)))):
        np.testing.assert_array_equal(a, b)
    found, ends = made.step(points, u, 0.0, 5), made.step(x, u, 0.0, 5)
    rates = made.flow(points, u, 0.0)
    for i, value in enumerate(mass):
        single = mujoco.MjModel.__copy__(model)
        getattr(single, field)[index] = value
        alone = backend.create(single)
        expected = alone.step(x[i : i + 1], u[i : i + 1], 0.0, 5)[0]
        np.testing.assert_allclose(found[i], np.tile(expected, (4, 1)), rtol=1e-12)
        np.testing.assert_allclose(ends[i], expected, rtol=1e-12)
        rate = alone.flow(x[i : i + 1], u[i : i + 1], 0.0)[0]
        np.testing.assert_allclose(rates[i, 2], rate, rtol=1e-9, atol=1e-12)
    assert np.ptp(found[:, 0], axis=0).max() > 1e-6
    made.close()


def test_readings_see_the_parameters():
    model = zoo_model("sensors")
    x, u = random_states(model, 2)
    mass = Parameter("body_mass", 2, np.array([0.3, 0.6]))
    made = VariedBackend(backend.create(model), [mass])
    address = model.sensor("force").adr[0]
    columns = np.arange(address, address + 3)
    x[1] = x[0]
    u[1] = u[0]
    light, heavy = made.read(x, u, 0.0, int(mujoco.mjtStage.mjSTAGE_ACC), columns)
    assert np.abs(light - heavy).max() > 0.1
