import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from estbench.spaces import rotation

number = st.floats(-1.0, 1.0, width=32).map(float)
vectors = st.tuples(number, number, number).map(lambda v: 3.0 * np.array(v))
quaternions = vectors.map(rotation.exp)


def scipy_rotation(q):
    return Rotation.from_quat(np.roll(q, -1, axis=-1))


@given(quaternions, quaternions)
def test_multiply_is_mujocos(p, q):
    expected = np.empty(4)
    mujoco.mju_mulQuat(expected, p, q)
    np.testing.assert_allclose(rotation.multiply(p, q), expected, atol=1e-15)


@given(quaternions)
def test_conjugate_is_the_inverse(q):
    product = rotation.multiply(q, rotation.conjugate(q))
    np.testing.assert_allclose(product, [1, 0, 0, 0], atol=1e-14)


@given(vectors)
def test_exp_is_scipys(phi):
    matrix = scipy_rotation(rotation.exp(phi)).as_matrix()
    np.testing.assert_allclose(matrix, Rotation.from_rotvec(phi).as_matrix(), atol=1e-14)


@given(vectors)
def test_log_is_scipys_and_inverts_exp(phi):
    q = rotation.exp(phi)
    np.testing.assert_allclose(rotation.log(q), scipy_rotation(q).as_rotvec(), atol=1e-13)
    if np.linalg.norm(phi) < 3.1:
        np.testing.assert_allclose(rotation.log(q), phi, atol=1e-13)


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-12, 1e-9, 1e-8, 3e-8, 1e-7, 1e-4, 3.14159])
def test_log_inverts_exp_near_zero_and_near_pi(angle):
    phi = angle * np.array([0.48, -0.6, 0.64])
    np.testing.assert_allclose(rotation.log(rotation.exp(phi)), phi, rtol=1e-12, atol=0)


@given(vectors)
def test_q_and_minus_q_are_one_rotation(phi):
    q = rotation.exp(phi)
    if abs(q[0]) > 1e-12:
        np.testing.assert_array_equal(rotation.log(q), rotation.log(-q))
    assert np.linalg.norm(rotation.log(q)) <= np.pi + 1e-12


def test_normalize():
    q = np.array([[3.0, 0, 4.0, 0], [0, 0, 0, 0]])
    np.testing.assert_allclose(rotation.normalize(q), [[0.6, 0, 0.8, 0], [1, 0, 0, 0]])


def test_normalize_does_not_hide_a_nan():
    # A NaN reading turned into the identity would pass for a measurement.
    q = np.array([[np.nan] * 4, [1.0, np.nan, 0, 0], [2.0, 0, 0, 0]])
    out = rotation.normalize(q)
    assert np.isnan(out[:2]).any(axis=-1).all()
    np.testing.assert_array_equal(out[2], [1, 0, 0, 0])


@given(quaternions)
def test_matrix_is_scipys_and_from_matrix_inverts_it(q):
    matrix = rotation.matrix(q)
    np.testing.assert_allclose(matrix, scipy_rotation(q).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(rotation.matrix(rotation.from_matrix(matrix)), matrix, atol=1e-13)


@given(vectors, vectors)
def test_skew_is_the_cross_product(v, w):
    np.testing.assert_allclose(rotation.skew(v) @ w, np.cross(v, w), atol=1e-14)


@given(vectors)
def test_right_jacobian_against_differences(phi):
    step = 1e-6
    inverse = rotation.conjugate(rotation.exp(phi))

    def change(e):
        return rotation.log(rotation.multiply(inverse, rotation.exp(phi + e)))

    expected = [(change(e) - change(-e)) / (2 * step) for e in step * np.eye(3)]
    np.testing.assert_allclose(rotation.right_jacobian(phi), np.transpose(expected), atol=2e-9)


def test_right_jacobian_is_smooth_where_its_formula_changes():
    axis = np.array([0.6, 0.0, -0.8])
    below, above = rotation.right_jacobian(np.stack([0.9999e-4 * axis, 1.0001e-4 * axis]))
    np.testing.assert_allclose(below, above, atol=2e-8)
    slope = (np.eye(3) - above)[1, 2] / 1.0001e-4  # first order: skew(axis)/2
    assert slope == pytest.approx(0.5 * rotation.skew(axis)[1, 2], rel=1e-3)


def test_leading_axes():
    phi = np.random.default_rng(0).standard_normal((2, 5, 3))
    q = rotation.exp(phi)
    assert q.shape == (2, 5, 4)
    assert rotation.right_jacobian(phi).shape == (2, 5, 3, 3)
    np.testing.assert_array_equal(rotation.log(q)[1, 3], rotation.log(q[1, 3]))
    np.testing.assert_array_equal(rotation.multiply(q, q)[1, 3], rotation.multiply(*[q[1, 3]] * 2))
