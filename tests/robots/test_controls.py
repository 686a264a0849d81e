from types import SimpleNamespace

import numpy as np

from estbench.robots.controls import ControlRange
from tests.helpers import zoo_model


def test_clamp():
    model = zoo_model("joints")  # lifter is limited to ±1, swinger is free
    u = np.array([[[-5.0, -5.0], [0.5, 0.5]], [[2.0, 7.0], [-1.0, 0.0]]])
    expected = [[[-1.0, -5.0], [0.5, 0.5]], [[1.0, 7.0], [-1.0, 0.0]]]
    np.testing.assert_array_equal(ControlRange.of(model).clamp(u), expected)
    free = SimpleNamespace(
        actuator_ctrllimited=np.zeros(2, np.uint8), actuator_ctrlrange=np.zeros((2, 2))
    )
    np.testing.assert_array_equal(ControlRange.of(free).clamp(u), u)
