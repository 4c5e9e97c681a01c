from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.kinematics.transform import FloatArray, matrix_from_quaternion, quaternion_from_matrix, rpy_from_matrix

angle = st.floats(-math.pi, math.pi)


def rotation(roll: float, pitch: float, yaw: float) -> FloatArray:
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (math.cos, math.sin))
    Rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    Ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    Rz = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return np.asarray(Rz @ Ry @ Rx)


@given(angle, angle, angle)
@settings(deadline=None)
def test_quaternion_round_trips_the_matrix(roll: float, pitch: float, yaw: float) -> None:
    R = rotation(roll, pitch, yaw)
    q = quaternion_from_matrix(R)
    assert q[3] >= 0.0
    assert math.isclose(sum(c * c for c in q), 1.0, abs_tol=1e-12)
    np.testing.assert_allclose(matrix_from_quaternion(q), R, atol=1e-12)


@given(angle, st.floats(-math.pi / 2, math.pi / 2), angle)
@settings(deadline=None)
def test_rpy_round_trips_the_matrix(roll: float, pitch: float, yaw: float) -> None:
    R = rotation(roll, pitch, yaw)
    # Near the gimbal lock the angles are ill defined, the matrix is not.
    np.testing.assert_allclose(rotation(*rpy_from_matrix(R)), R, atol=1e-9)


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
