import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armctl.kinematics import transform
from armctl.kinematics.transform import matrix_from_quaternion, matrix_from_rpy, quaternion_from_matrix, rpy_from_matrix
from tests.kinematics.conftest import X, Y, Z, turn

angle = st.floats(-math.pi, math.pi)


def rotation(roll: float, pitch: float, yaw: float) -> transform.FloatArray:
    return np.asarray((turn(Z, yaw) @ turn(Y, pitch) @ turn(X, roll))[:3, :3])


@given(angle, angle, angle)
def test_quaternion_round_trips_the_matrix(roll: float, pitch: float, yaw: float) -> None:
    R = rotation(roll, pitch, yaw)
    q = quaternion_from_matrix(R)
    assert q[3] >= 0.0
    assert math.isclose(sum(c * c for c in q), 1.0, abs_tol=1e-12)
    np.testing.assert_allclose(matrix_from_quaternion(q), R, atol=1e-12)


@given(angle, st.floats(-math.pi / 2, math.pi / 2), angle)
def test_rpy_round_trips_the_matrix(roll: float, pitch: float, yaw: float) -> None:
    R = rotation(roll, pitch, yaw)
    np.testing.assert_allclose(matrix_from_rpy(roll, pitch, yaw), R, atol=1e-15)
    # Near the gimbal lock the angles are ill defined, the matrix is not.
    tolerance = 1e-12 if abs(pitch) <= 1.5 else 1e-9
    np.testing.assert_allclose(matrix_from_rpy(*rpy_from_matrix(R)), R, atol=tolerance)


@pytest.mark.parametrize("pitch", [math.pi / 2, -math.pi / 2])
def test_gimbal_lock_has_zero_roll(pitch: float) -> None:
    R = rotation(0.4, pitch, 0.9).round(15)
    roll, found, _ = rpy_from_matrix(R)
    assert roll == 0.0
    assert found == pytest.approx(pitch)
    np.testing.assert_allclose(rotation(*rpy_from_matrix(R)), R, atol=1e-12)


@pytest.mark.parametrize("axis", range(3))
def test_half_turns_have_a_quaternion(axis: int) -> None:
    R = -np.eye(3)
    R[axis, axis] = 1.0
    expected = [0.0, 0.0, 0.0, 0.0]
    expected[axis] = 1.0
    np.testing.assert_allclose(np.abs(quaternion_from_matrix(R)), expected, atol=1e-15)


@given(angle, angle, angle, st.floats(0.0, math.pi))
def test_rotation_vector_is_axis_times_angle(x: float, y: float, z: float, angle_rad: float) -> None:
    axis = np.array([x, y, z + 4.0])
    axis /= np.linalg.norm(axis)
    half = math.sin(angle_rad / 2.0)
    R = matrix_from_quaternion((axis[0] * half, axis[1] * half, axis[2] * half, math.cos(angle_rad / 2.0)))
    found = transform.rotation_vector(R)
    if angle_rad > math.pi - 1e-6:
        found = found * np.sign(found @ axis)  # half a turn either way is the same
    np.testing.assert_allclose(found, axis * angle_rad, atol=1e-7 if angle_rad > 3.0 else 1e-12)


def test_rotation_error_turns_one_rotation_into_the_other() -> None:
    rng = np.random.default_rng(0)
    A, B = (np.array([matrix_from_rpy(*rng.uniform(-1.5, 1.5, 3)) for _ in range(20)]) for _ in range(2))
    error = transform.rotation_error(A, B)
    angle = np.linalg.norm(error, axis=-1, keepdims=True)
    half = error / angle * np.sin(angle / 2.0)
    for R, wanted, v, w in zip(A, B, half, np.cos(angle[:, 0] / 2.0), strict=True):
        np.testing.assert_allclose(matrix_from_quaternion((*v.tolist(), float(w))) @ R, wanted, atol=1e-12)
