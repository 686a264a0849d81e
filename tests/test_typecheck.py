"""The check of shapes finds a wrong shape, and leaves estbench's own errors alone."""

import numpy as np
import pytest
from beartype.roar import BeartypeDoorHintViolation

from estbench.estimators.beliefs import Gaussian, check_prior
from estbench.models.protocol import Model
from estbench.shapes import Array, Float
from estbench.simulation.sources import Trajectory
from estbench.spaces import rotation
from tests import typecheck


def test_a_wrong_shape_is_found():
    faults = np.zeros(2, np.uint8)
    Gaussian(np.zeros((2, 3)), np.zeros((2, 3, 3)), faults)
    with pytest.raises(BeartypeDoorHintViolation, match=r"Gaussian\.__init__: cov"):
        Gaussian(np.zeros((2, 3)), np.zeros((1, 3, 3)), faults)
    with pytest.raises(BeartypeDoorHintViolation, match=r"rotation\.conjugate: q"):
        rotation.conjugate(np.zeros((2, 1)))


def test_lengths_that_belong_together_are_compared():
    Trajectory(np.zeros((4, 2, 3)), np.zeros((3, 2, 1)), [])
    with pytest.raises(BeartypeDoorHintViolation, match=r"Trajectory\.__init__: u"):
        Trajectory(np.zeros((4, 2, 3)), np.zeros((4, 2, 1)), [])


def test_a_wrong_result_is_found():
    @typecheck.checked
    def square(x: Float[Array, " n"]) -> Float[Array, "n n"]:
        return x

    with pytest.raises(BeartypeDoorHintViolation, match="square: return"):
        square(np.zeros(2))


def test_the_first_calls_of_every_test_function_are_checked():
    @typecheck.checked
    def same(x: Float[Array, " n"]) -> Float[Array, " n"]:
        return x

    for _ in range(typecheck.CALLS):
        same(np.zeros(2))
    same(np.zeros((2, 2)))
    typecheck.begin_test("another")
    with pytest.raises(BeartypeDoorHintViolation):
        same(np.zeros((2, 2)))


def test_an_error_of_estbench_comes_first():
    with pytest.raises(Exception, match="expected \\(run, nx\\)"):
        check_prior(None, np.zeros((2, 3)), np.zeros((3, 3, 3)))


def test_only_annotations_with_a_shape_are_checked():
    assert typecheck.has_shape(tuple[Float[Array, "n n"], int])
    assert not typecheck.has_shape(Model)
    assert not typecheck.has_shape(Array | None)
